"""Runs one episode of any environment of Gymnasium's API, described by seeds, options, success and sub-tasks.

Nothing here imports gymnasium: an environment is any object with `reset(seed=, options=)` and `step(action)`. What can fail: an environment whose
`info` lacks a requested key (`EvaluationError`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from . import _numbers
from .errors import EvaluationError, InputError

SUCCESS = ("is_success", "success")
COMPLETED = "episode_task_completions"


@dataclass(frozen=True)
class Rollout:
    """Result of one episode."""

    steps: int
    """Number of control steps executed."""
    total_reward: float
    """Sum of the rewards."""
    terminated: bool
    truncated: bool
    """True if the environment, or `max_steps`, ended the episode early."""
    info: Mapping
    """Info of the last step."""
    completions: tuple[tuple[str, int], ...]
    """Sub-tasks with the number of control steps after which they were first done, 0 if from the start, in order of time."""


@dataclass(frozen=True)
class Rules:
    """Rules by which episodes are begun, ended and judged."""

    options: object = None
    """Options of `reset`: a dictionary, or a callable of the episode's number."""
    max_steps: int | None = None
    success: object = None
    """Success of an episode: a key of the last `info`, or a callable of the `Rollout`."""
    sub_tasks: tuple[str, ...] = ()
    completed: object = None
    """Names of the sub-tasks that are done: a key of `info`, or a callable of it."""

    def __post_init__(self):
        if self.max_steps is not None:
            _numbers.whole("max_steps", self.max_steps, 1, error=EvaluationError)

    def reset_options(self, episode):
        """Returns the options of `reset`."""
        return self.options(episode) if callable(self.options) else self.options

    def done(self, info):
        """Returns the names of the requested sub-tasks that are done."""
        if not self.sub_tasks:
            return []
        if callable(self.completed):
            names = self.completed(info)
        else:
            key = self.completed or COMPLETED
            if key not in info:
                raise EvaluationError(f"the environment's info has no {key!r}; give completed=, a key or a callable that names the sub-tasks that are done")
            names = info[key]
        done = set(names)
        return [name for name in self.sub_tasks if name in done]

    def judge(self, rollout):
        """Returns whether an episode was a success; None if nothing defines success."""
        if callable(self.success):
            return bool(self.success(rollout))
        if self.success is not None:
            if self.success not in rollout.info:
                raise EvaluationError(f"the last info of an episode has no {self.success!r}; give success=, a key that it has or a callable of the rollout")
            return bool(rollout.info[self.success])
        if self.sub_tasks:
            return len(rollout.completions) == len(self.sub_tasks)
        return next((bool(rollout.info[key]) for key in SUCCESS if key in rollout.info), None)


def episode_seed(seed, episode):
    """Returns the seed of an episode, of 32 bits, independent of other episodes and of the process."""
    seed, episode = (_numbers.whole(name, value, error=EvaluationError) for name, value in (("seed", seed), ("episode", episode)))
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


def play(environment, act, rules, seed, episode, watch=None):
    """Runs one episode by `act(observation) -> action` -> Rollout. `watch(observation)` is called once with every observation, the last one too.

    `act` may return None to give up: the episode is over.
    """
    observation, info = environment.reset(seed=episode_seed(seed, episode), options=rules.reset_options(episode))
    steps, total, terminated, truncated = 0, 0.0, False, False
    completions = dict.fromkeys(rules.done(info), 0) if _says(rules, info) else {}
    if watch:
        watch(observation)
    while not (terminated or truncated):
        action = act(observation)
        if action is None:
            break
        observation, reward, terminated, truncated, info = environment.step(action)
        steps += 1
        total += float(reward)
        for name in rules.done(info):
            completions.setdefault(name, steps)
        truncated = truncated or steps == rules.max_steps
        if watch:
            watch(observation)
    return Rollout(steps, total, bool(terminated), bool(truncated), info, tuple(completions.items()))


def _says(rules, info):
    """Returns whether the info of a reset reports sub-tasks; that of most environments does not."""
    return callable(rules.completed) or (rules.completed or COMPLETED) in info


def convert(observation, channels):
    """Converts an environment's observation to a controller's: arrays of each channel's dtype, one or a dictionary by name."""
    if isinstance(observation, Mapping):
        missing = [channel.name for channel in channels if channel.name not in observation]
        if missing:
            names = ", ".join(map(repr, missing))
            raise InputError(f"the environment's observation has no {names}, it has {', '.join(map(repr, observation))}; give observation=, a callable that makes what the policy takes")
        arrays = {channel.name: _cast(observation[channel.name], channel) for channel in channels}
        return arrays if len(channels) > 1 else arrays[channels[0].name]
    if len(channels) > 1:
        names = ", ".join(repr(channel.name) for channel in channels)
        raise InputError(f"the policy observes {names}, the environment gives one {type(observation).__name__}; give observation=, a callable that makes a dictionary")
    return _cast(observation, channels[0])


def _cast(value, channel):
    # What one number is in the environment is an array of one element here.
    array = np.atleast_1d(np.asarray(value))
    if array.shape != channel.shape:
        raise InputError(f"channel {channel.name!r}: the environment gives shape {array.shape}, the policy takes {channel.shape}; give observation=, a callable that makes one of the other")
    if channel.dtype.kind == "f" and array.dtype.kind in "fiub":
        return np.ascontiguousarray(array, channel.dtype)
    if not np.can_cast(array.dtype, channel.dtype, "same_kind") or array.dtype.kind == "f":
        raise InputError(f"channel {channel.name!r}: the environment gives {array.dtype}, the policy takes {channel.dtype}; give observation=, a callable that converts it")
    cast = np.ascontiguousarray(array, channel.dtype)
    if not np.array_equal(cast, array):
        raise InputError(f"channel {channel.name!r}: a value of the environment does not fit into {channel.dtype}; give observation=, a callable that converts it")
    return cast


def command(action, space):
    """Converts a policy's action, float32 [n], to the environment's action space."""
    if space is None or not hasattr(space, "shape") or not hasattr(space, "dtype"):
        return action
    if np.dtype(space.dtype).kind != "f":
        raise EvaluationError(f"the environment takes {space}, the policy gives {len(action)} floats; give action=, a callable that turns one into the other")
    if int(np.prod(space.shape)) != len(action):
        raise EvaluationError(f"the environment takes actions of shape {space.shape}, the policy gives {len(action)} elements; give action=, a callable that turns one into the other")
    return action.reshape(space.shape).astype(space.dtype, copy=False)
