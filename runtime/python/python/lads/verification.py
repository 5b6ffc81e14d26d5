"""Verifies that the deployed policy is the one that was trained: three comparisons with a reference, judged by the statistics of `lads-run verify`.

The policy alone (the reference's observations, asked again), the environment alone (the reference's actions, executed again), and both
together (the same episodes in closed loop, as pairs). This module runs the episodes; `lads_proof`, in Rust, judges and writes the certificate. What
can fail: an environment that does not define success, or takes less than the contract's limits allow; a reference whose action has
another shape, or which gives plans without scores.
"""

from __future__ import annotations

import base64
import json
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import _lads, _numbers
from .errors import EvaluationError, LadsError, ProofError
from .rollout import Rollout, Rules, command, convert, play

FORMAT, FORMAT_VERSION = "lads-reference", 2
# A margin that is infinite, of a single index, as a number that JSON has.
LARGEST = 1e300


@dataclass(frozen=True)
class Reply:
    """Answer of a reference that also states its selected index; a reference that returns only an action is compared by its actions."""

    action: np.ndarray
    """Action `[actions]`, in the contract's units."""
    plan: int | None = None
    """The index in force."""
    logits: np.ndarray | None = None
    """The scores, one per index, of a step that selects, such as the first of an episode; None in a step that keeps its index."""


@dataclass(frozen=True)
class Certificate:
    """The verdict of a verification, with its evidence."""

    verdict: str
    """Verdict: `EQUIVALENT`, `DIFFERENT` or `INCONCLUSIVE`."""
    reasons: tuple[str, ...]
    data: dict
    """The certificate of `lads-run verify`, as data."""
    json: str
    html: str

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes the page if the name ends in .html, otherwise the JSON; the file is written completely or not at all."""
        _lads.write(path, self.html if Path(path).suffix == ".html" else self.json + "\n")

    def __str__(self) -> str:
        return "\n".join([self.verdict, *(f"- {reason}" for reason in self.reasons)])


def verify(
    reference: Callable[[Any], Any],
    controller: _lads.Controller,
    make_env: Callable[[], Any],
    *,
    episodes: int = 150,
    seed: int = 0,
    traced: int = 10,
    instructions: Sequence[str] | None = None,
    observation: Callable[[Any], Any] | None = None,
    action: Callable[[np.ndarray], Any] | None = None,
    state: Callable[[Any, Any], Any] | None = None,
    options: Mapping | Callable[[int], Mapping | None] | None = None,
    max_steps: int | None = None,
    success: str | Callable[[Rollout], bool] | None = None,
    sub_tasks: Sequence[str] | Mapping[str, Sequence[str]] = (),
    completed: str | Callable[[Mapping], Sequence[str]] | None = None,
    control_period: float | None = None,
    reference_name: str | None = None,
    progress: Callable[[int, int], None] | bool | None = None,
) -> Certificate:
    """Compares a controller's policy with a reference in the environment that `make_env()` makes -> `Certificate`.

    `reference(observation)` is any callable: it gets the controller's input, arrays of the channels' dtypes, and returns the action, an array
    [actions], or a `Reply`. Its method `reset`, if any, is called when an episode begins, with the instruction if `instructions` are given.
    Without `action`, its actions are clipped to the environment's action space, inside which the contract's limits have to lie. Each of
    `episodes` is run by both, of each of `instructions` (by default the one that the controller follows); the first `traced` of them are
    compared step by step. `sub_tasks` may be a dictionary by instruction. `state(environment, observation)` returns the state by which the environment alone
    is compared, by default the observation. `control_period` is the reference's, in seconds, by default the environment's `dt`; without
    either the contract is not compared, and nothing is EQUIVALENT. The other arguments are those of `lads.gym.evaluate`. 59 episodes are the fewest that can be EQUIVALENT, 146 with four sub-tasks.
    """
    _numbers.instance("controller", controller, _lads.Controller, "policy.controller(...)")
    for name, value in (("reference", reference), ("make_env", make_env)):
        _numbers.instance(name, value, Callable, "a callable")
    _numbers.callables(observation=observation, action=action, state=state)
    episodes, traced = (_numbers.whole(name, value, 1, _numbers.MOST, ProofError) for name, value in (("episodes", episodes), ("traced", traced)))
    seed = _numbers.whole("seed", seed, 0, _numbers.SEED, ProofError)
    control_period = control_period if control_period is None else _numbers.real("control_period", control_period, ProofError)
    known = list(_numbers.names("instructions", instructions, ProofError)) if instructions is not None else [controller.instruction or ""]
    if not known:
        raise ProofError("instructions: none is given; give one or more, or leave them out")
    if instructions is None and controller.policy.contract.context.words and not known[0]:
        raise ProofError("the controller follows no known instruction; give instructions=, or a controller that does")
    missing = [row for row in known if row not in sub_tasks] if isinstance(sub_tasks, Mapping) else []
    if missing:
        raise ProofError(f"sub_tasks: it has none of {missing[0]!r}; give those of every instruction")
    tasks = [_numbers.names("sub_tasks", sub_tasks[row] if isinstance(sub_tasks, Mapping) else sub_tasks, ProofError) for row in known]
    setting = _Setting(controller, make_env, seed, min(traced, episodes), observation, action, state)
    report = progress if callable(progress) else _progress(progress)
    environment = make_env()
    ours, theirs, replayed = [], [], []
    try:
        for index, (instruction, commanded) in enumerate(zip(known, tasks)):
            rules = Rules(options, max_steps, success, commanded, completed)
            asked = _Reference(reference, setting, environment, instruction if instructions is not None else None)
            deployed = _Deployed(setting, environment, instruction, asked)
            rows = [[], []]
            for number in range(episodes):
                for row, side in zip(rows, (asked, deployed)):
                    row.append(_episode(environment, side, rules, setting, number))
                if number < setting.traced:
                    replayed.append((index, number, *_replay(environment, asked.commands, rules, setting, number)))
                report(index * episodes + number + 1, len(known) * episodes)
            for side, row in zip((theirs, ours), rows):
                side.append({"id": instruction, "text": instruction, "split": "", "sub_tasks": commanded, "episodes": row})
        about = _about(setting, environment, tasks, theirs, control_period)
    finally:
        getattr(environment, "close", lambda: None)()
    name = reference_name or f"the callable {getattr(reference, '__name__', type(reference).__name__)}"
    head = {"seed": seed, "episodes": episodes, "traced": setting.traced, "name": name}
    verdict, text, page = _lads.judge(controller, _file(head, theirs), _file(head, ours), replayed, json.dumps(about))
    data = json.loads(text)
    return Certificate(verdict, tuple(data["reasons"]), data, text, page)


def _progress(wanted):
    from .gym import Progress

    return Progress(wanted)


@dataclass(frozen=True)
class _Setting:
    controller: object
    make_env: object
    seed: int
    traced: int
    observation: object
    action: object
    state: object

    @property
    def contract(self):
        return self.controller.policy.contract

    def seen(self, observation):
        """Returns the policy's input."""
        return convert(self.observation(observation) if self.observation else observation, self.contract.observations)

    def row(self, seen):
        """Returns the policy's input as one row of floats, channel by channel."""
        arrays = [seen[channel.name] for channel in self.contract.observations] if isinstance(seen, dict) else [seen]
        return np.concatenate([np.ravel(array) for array in arrays]).astype("<f4")

    def commanded(self, action, environment):
        """Returns the environment's input for an action."""
        return self.action(action) if self.action else command(action, getattr(environment, "action_space", None))

    def state_of(self, environment, observation):
        found = self.state(environment, observation) if self.state else observation
        return np.ravel(_flat(found)).astype("<f8")


def _flat(value):
    if hasattr(value, "keys"):
        return np.concatenate([np.ravel(_flat(value[key])) for key in sorted(value)])
    return np.asarray(value, np.float64)


class _Side:
    """One of the two sides that are compared: drives an episode and records it."""

    def __init__(self, setting, environment):
        self.setting, self.environment = setting, environment

    def begin(self):
        self.observations, self.actions, self.commands = [], [], []
        self.gave_up = False
        self.plans, self.margins, self.decided_at, self.logits = [], [], [], []
        self.begin_episode()

    def __call__(self, observation):
        seen = self.setting.seen(observation)
        action = self.answer(seen)
        if action is None:
            return None
        self.observations.append(self.setting.row(seen))
        self.actions.append(action)
        done = self.setting.commanded(action, self.environment)
        self.commands.append(done)
        return done

    def decide(self, plan, margin, logits):
        self.decided_at.append(len(self.actions))
        self.plans.append(int(plan))
        self.margins.append(min(float(margin), LARGEST))
        self.logits.append(np.asarray(logits, "<f4"))


class _Reference(_Side):
    def __init__(self, reference, setting, environment, instruction):
        super().__init__(setting, environment)
        self.reference, self.instruction = reference, instruction
        space = getattr(environment, "action_space", None)
        channel = setting.contract.action
        self.limits = None
        # A space of another size is named where an action is executed.
        if setting.action is None and hasattr(space, "low") and np.size(space.low) == np.prod(channel.shape):
            self.limits = np.ravel(space.low), np.ravel(space.high)
            _inside(channel, *self.limits)

    def begin_episode(self):
        reset = getattr(self.reference, "reset", None)
        if reset:
            reset(*([] if self.instruction is None else [self.instruction]))

    def answer(self, seen):
        reply = self.reference(seen)
        action = reply.action if isinstance(reply, Reply) else reply
        action = np.array(action, np.float32)  # a copy: it may be an array that the reference goes on using
        wanted = self.setting.contract.action.shape
        if action.shape != wanted:
            raise ProofError(f"the reference gives an action of shape {action.shape}, the contract says {wanted}; give one that does")
        if self.limits:
            action = np.clip(action, *self.limits).astype(np.float32)
        if isinstance(reply, Reply) and reply.plan is not None and reply.logits is None and not self.plans:
            raise ProofError("the reference gives a plan before it has given scores; give lads.Reply(action, plan, logits) in every step that selects, or the action alone")
        if isinstance(reply, Reply) and reply.logits is not None:
            ordered = np.sort(np.asarray(reply.logits, np.float64))
            plan = int(np.argmax(reply.logits)) if reply.plan is None else reply.plan
            self.decide(plan, ordered[-1] - ordered[-2] if len(ordered) > 1 else np.inf, reply.logits)
        return action


def _inside(channel, low, high):
    """Refuses a contract whose action could leave the environment's action space, to which the reference's alone would be clipped."""
    rows = channel.elements or [channel] * len(low)
    wide = [row.name for row, least, most in zip(rows, low, high) if np.float32(row.min) < np.float32(least) or np.float32(row.max) > np.float32(most)]
    if wide:
        raise ProofError(f"the contract's limits of {', '.join(dict.fromkeys(wide))} exceed the environment's action space; give action=, a callable that makes what the environment takes")


class _Deployed(_Side):
    """The controller's policy, whose selections are recorded if the reference states its own."""

    def __init__(self, setting, environment, instruction, asked):
        super().__init__(setting, environment)
        self.asked = asked
        sample, noise, portable = setting.controller._settings
        told = instruction if setting.contract.context.words else None
        self.controller = setting.controller.policy.controller(told, sample=sample, noise=noise, portable=portable)

    def begin_episode(self):
        self.controller.reset()

    def answer(self, seen):
        try:
            action, report = self.controller.step(seen)
        except LadsError:
            self.gave_up = True
            return None  # a policy that refuses has failed; why is what the comparison step by step says
        if self.asked.plans and report.selected and report.selected.fresh:
            self.decide(report.selected.index, report.selected.margin, self.controller.scores)
        return action


def _episode(environment, side, rules, setting, number):
    """Runs one episode and returns it in the form of a reference's file."""
    traced = number < setting.traced
    states = []

    def watch(observation):
        if traced:
            states.append(setting.state_of(environment, observation))
        else:
            states[:] = [setting.state_of(environment, observation)]

    side.begin()
    rollout = play(environment, side, rules, setting.seed, number, watch)
    judged = False if side.gave_up else rules.judge(rollout)
    if judged is None:
        raise EvaluationError("the environment's info says nothing about success; give success=, a key of the last info or a callable of the rollout")
    row = {
        "episode": number,
        "steps": rollout.steps,
        "success": judged,
        "completions": [{"sub_task": name, "step": step} for name, step in rollout.completions],
        "plans": side.plans,
        "margins": side.margins,
        "decided_at": side.decided_at,
        "final_state": states[-1].tolist(),
    }
    if traced:
        row["trace"] = {
            "observations": _text(side.observations, "<f4"),
            "actions": _text(side.actions, "<f4"),
            "states": _text(states, "<f8"),
            "logits": _text(side.logits, "<f4"),
        }
    return row


def _text(rows, kind):
    data = np.concatenate(rows).astype(kind).tobytes() if rows else b""
    return base64.b64encode(data).decode()


def _replay(environment, commands, rules, setting, number):
    """Returns the environment's states under the reference's actions, float64 [n, S], and whether it ended the episode with the last of them."""
    states, rest = [], iter(commands)
    rollout = play(
        environment,
        lambda _: next(rest, None),
        rules,
        setting.seed,
        number,
        lambda observation: states.append(setting.state_of(environment, observation)),
    )
    return np.stack(states), rollout.terminated or rollout.truncated


def _about(setting, environment, tasks, theirs, control_period):
    """Returns the facts that are judged besides the rollouts."""
    contract = setting.contract
    not_covered = ["the contract beyond its control period: neither the reference nor the environment states more"]
    decides = any(episode["plans"] for row in theirs for episode in row["episodes"])
    if not decides and contract.indices:
        not_covered.append("indices and their scores: the reference gives actions alone (lads.Reply has both)")
    if contract.noise_elements:
        not_covered.append("noise: the policy draws its own")
    known = [instruction.id for instruction in contract.instructions]
    if contract.context.words and len(theirs) < len(known):
        not_covered.append(f"{len(known) - len(theirs)} of {len(known)} instructions")
    longest = max(episode["steps"] for row in theirs for episode in row["episodes"][: setting.traced])
    if contract.context.steps and longest <= contract.context.steps:
        not_covered.append(f"what happens after {longest} control steps: no replayed episode is longer, and the policy's context holds {contract.context.steps}")
    period = control_period if control_period is not None else _period(environment)
    names = list(dict.fromkeys(name for commanded in tasks for name in commanded))
    spec = getattr(environment, "spec", None)
    return {
        "environment": getattr(spec, "id", None) or type(getattr(environment, "unwrapped", environment)).__name__,
        "noise": "the environment's own",
        "versions": _versions(),
        "sub_tasks": names,
        "commanded": [[names.index(name) for name in commanded] for commanded in tasks],
        # Dtypes and shapes are not among them: what the reference gets is made by the contract.
        "contract": {"control_period_s": contract.control_period},
        "stated": {} if period is None else {"control_period_s": float(period)},
        "not_covered": not_covered,
    }


def _period(environment):
    """Returns the environment's control period in seconds, if it states one."""
    value = getattr(getattr(environment, "unwrapped", environment), "dt", None)
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _versions():
    versions = {"lads": _lads.__version__, "python": platform.python_version(), "numpy": np.__version__}
    for name in ("gymnasium", "gymnasium_robotics", "mujoco", "torch", "onnxruntime", "jax"):
        module = sys.modules.get(name)
        if module is not None and hasattr(module, "__version__"):
            versions[name] = str(module.__version__)
    return versions


def _file(head, rows):
    """Returns rollouts in the form of a reference's file."""
    return json.dumps(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "bundle_sha256": "",
            "purpose_sha256": "",
            "environment": {"id": "", "version": ""},
            "seed": head["seed"],
            "noise": "",
            "horizon": None,
            "episodes_per_instruction": head["episodes"],
            "traced_episodes": head["traced"],
            "weights_from": head["name"],
            "words_from": "the caller",
            "contract": None,
            "logits_from": None,
            "float_noise": None,
            "versions": _versions(),
            "instructions": rows,
        }
    ).encode()
