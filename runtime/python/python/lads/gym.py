"""Runs policies in environments of Gymnasium's API: `evaluate` measures success, `Policy` is for the caller's own loops."""

from __future__ import annotations

import json
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import _lads, _numbers
from .errors import EvaluationError, LadsError
from .rollout import Rollout, Rules, command, convert, episode_seed, play

__all__ = ["Episode", "Evaluation", "Policy", "Rate", "Rollout", "evaluate"]


class Policy:
    """A controller as a callable from an environment's observation to its action.

    `observation` and `action` convert between the environment and the policy, if dtype, names and shapes alone do not determine how; `space` is
    the environment's action space. Call `reset` at the start of every episode.
    """

    def __init__(
        self,
        controller: _lads.Controller,
        observation: Callable[[Any], Any] | None = None,
        action: Callable[[np.ndarray], Any] | None = None,
        space: Any = None,
    ) -> None:
        self.controller = controller
        self.report = None
        self._channels = controller.policy.contract.observations
        self._observation, self._action, self._space = observation, action, space

    def reset(self) -> None:
        """Starts a new episode with the same instruction."""
        self.controller.reset()

    def __call__(self, observation: Any) -> Any:
        """Returns the environment's action for its observation; `report` has the step's `lads.StepReport` afterwards."""
        seen = self._observation(observation) if self._observation else observation
        action, self.report = self.controller.step(convert(seen, self._channels))
        return self._action(action) if self._action else command(action, self._space)


@dataclass(frozen=True)
class Rate:
    """Share of episodes in which something happened."""

    count: int
    """Number of episodes in which it happened."""
    episodes: int
    """Number of episodes in which it could happen."""

    def __post_init__(self) -> None:
        _numbers.whole("episodes", self.episodes, 1, _numbers.SEED, EvaluationError)
        _numbers.whole("count", self.count, 0, self.episodes, EvaluationError)

    @property
    def rate(self) -> float:
        """Success rate, `count` over `episodes`."""
        return self.count / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """The Wilson score interval at 95 %: (low, high)."""
        return _lads.wilson(self.count, self.episodes)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.rate:.3f} [{low:.3f}, {high:.3f}] ({self.count} of {self.episodes})"


@dataclass(frozen=True)
class Episode:
    """One episode of an evaluation."""

    number: int
    seed: int
    """Seed that `reset` was given."""
    steps: int
    total_reward: float
    terminated: bool
    truncated: bool
    success: bool | None
    """True if the episode was a success; None if nothing defines success."""
    completions: tuple[tuple[str, int], ...]
    """Sub-tasks with the number of control steps after which they were first done, 0 if from the start."""


@dataclass(frozen=True)
class Evaluation:
    """Results of an evaluation."""

    episodes: tuple[Episode, ...]
    """Episodes in the order of their numbers."""
    seed: int
    score: dict | None
    """N-rate, K-rates and full success of episodes with sub-tasks, each with its interval; otherwise None."""

    @property
    def success(self) -> Rate | None:
        """Share of successful episodes; None if nothing defines success."""
        known = [episode.success for episode in self.episodes if episode.success is not None]
        return Rate(sum(known), len(known)) if known else None

    @property
    def mean_reward(self) -> float:
        """Mean of the episodes' total rewards."""
        return float(np.mean([episode.total_reward for episode in self.episodes]))

    @property
    def mean_steps(self) -> float:
        """Mean number of control steps."""
        return float(np.mean([episode.steps for episode in self.episodes]))

    def __str__(self) -> str:
        success = f"success {self.success}, " if self.success else ""
        rates = f"N-rate {self.score['n_rate']:.3f}, " if self.score else ""
        return f"{len(self.episodes)} episodes: {success}{rates}total reward {self.mean_reward:.6g}, {self.mean_steps:.1f} steps"


def evaluate(
    controller: _lads.Controller,
    make_env: Callable[[], Any],
    episodes: int = 100,
    seed: int = 0,
    *,
    observation: Callable[[Any], Any] | None = None,
    action: Callable[[np.ndarray], Any] | None = None,
    options: Mapping | Callable[[int], Mapping | None] | None = None,
    max_steps: int | None = None,
    success: str | Callable[[Rollout], bool] | None = None,
    sub_tasks: Sequence[str] = (),
    completed: str | Callable[[Mapping], Sequence[str]] | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | bool | None = None,
) -> Evaluation:
    """Runs a controller's policy and instruction in `episodes` episodes of the environment that `make_env()` makes -> `Evaluation`.

    Every episode has a seed of its own, so that its result does not depend on the others nor on `processes`; it is run by a fresh
    controller, `controller` itself is unchanged. `options` is for `reset`, a dictionary or a callable of the episode's number; `success` is a
    key of the last `info` or a callable of the `Rollout`, by default `is_success` or `success` if the info has one, or that all `sub_tasks`
    are done; `completed` is a key of `info`, or a callable of it, for the names of the completed ones. `observation` and `action` convert, see
    `Policy`. With several processes all of this has to be picklable (with cloudpickle, where that is installed). `progress` is a callable of
    (finished, all), or False; by default progress is shown on a terminal.
    """
    _numbers.instance("controller", controller, _lads.Controller, "policy.controller(...)")
    episodes = _numbers.whole("episodes", episodes, 1, _numbers.MOST, EvaluationError)
    processes = _numbers.whole("processes", processes, 1, _numbers.MOST, EvaluationError)
    seed, sub_tasks = _numbers.whole("seed", seed, error=EvaluationError), _numbers.names("sub_tasks", sub_tasks)
    _numbers.instance("make_env", make_env, Callable, "a callable")
    _numbers.callables(observation=observation, action=action)
    job = _Job(
        controller.policy,
        controller._settings,
        controller._instruction,
        make_env,
        seed,
        Rules(options, max_steps, success, sub_tasks, completed),
        observation,
        action,
    )
    report = progress if callable(progress) else Progress(progress)
    found = []
    for episode in _serial(job, episodes) if processes == 1 else _parallel(job, episodes, processes):
        found.append(episode)
        report(len(found), episodes)
    found.sort(key=lambda episode: episode.number)
    return Evaluation(tuple(found), seed, _score(found) if sub_tasks else None)


def _score(episodes):
    return json.loads(_lads.score([(len(episode.completions), bool(episode.success)) for episode in episodes]))


class Progress:
    """Shows a line on the terminal: the number of finished episodes."""

    def __init__(self, wanted=None):
        self.wanted = sys.stderr.isatty() if wanted is None else wanted

    def __call__(self, finished, of):
        if self.wanted:
            print(f"\repisode {finished} of {of}", end="\n" if finished == of else "", file=sys.stderr, flush=True)


@dataclass(frozen=True)
class _Job:
    policy: object
    settings: tuple
    instruction: object
    make_env: object
    seed: int
    rules: Rules
    observation: object
    action: object

    def controller(self, episode):
        """Makes a fresh controller, with seeds of the episode's own."""
        sample, noise, portable = self.settings
        own = lambda start: None if start is None else (start + episode) % 2**64
        return self.policy.controller(self.instruction, sample=own(sample), noise=own(noise), portable=portable)

    def episode(self, environment, number):
        """Runs one episode."""
        with self.controller(number) as controller:
            policy = Policy(controller, self.observation, self.action, getattr(environment, "action_space", None))
            try:
                rollout = play(environment, policy, self.rules, self.seed, number)
            except LadsError as error:
                raise type(error)(f"episode {number}: {error}") from error
        return Episode(
            number,
            episode_seed(self.seed, number),
            rollout.steps,
            rollout.total_reward,
            rollout.terminated,
            rollout.truncated,
            self.rules.judge(rollout),
            rollout.completions,
        )


def _serial(job, episodes):
    environment = job.make_env()
    try:
        for number in range(episodes):
            yield job.episode(environment, number)
    finally:
        getattr(environment, "close", lambda: None)()


def _pickled(job):
    try:
        import cloudpickle
    except ImportError:
        cloudpickle = pickle
    try:
        return cloudpickle.dumps(job)
    except Exception as error:
        raise EvaluationError(f"make_env and the other callables cannot be sent to other processes ({error}); give functions of a module, or processes=1") from error


def _parallel(job, episodes, processes):
    # Not above: they take half of the time in which this package is imported.
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")  # threads of this process would not survive a fork
    with ProcessPoolExecutor(min(processes, episodes), context, _begin, (_pickled(job),)) as pool:
        try:
            # Small shares, so that long episodes do not gather in one process.
            yield from pool.map(_run, range(episodes), chunksize=max(1, episodes // (8 * processes)))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


_running = None


def _begin(pickled):
    global _running
    # Here for the same reason as above.
    from multiprocessing.util import Finalize

    job = pickle.loads(pickled)
    _running = job, job.make_env()
    close = getattr(_running[1], "close", None)
    if close:
        Finalize(None, close, exitpriority=0)  # with a priority, it is called when the process ends


def _run(number):
    job, environment = _running
    return job.episode(environment, number)
