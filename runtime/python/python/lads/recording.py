"""Records control steps in a file: MCAP, for Foxglove and other readers. `lads-run replay` takes only the logs of `lads-run --log`.

What can fail: a policy whose observation is not one vector of floats, noise that the caller gives, a path that cannot be written.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import _lads, _numbers
from .errors import RecordError


class Recorder:
    """Controller that records its steps, for a policy that observes one vector.

    It has a controller's `step`, `executed`, `reset`, `instruct` and `policy`, which is what a control loop and `lads.gym.Policy` use. `reset`
    and `instruct` begin a new episode, `end` gives the outcome of the last one. Nothing is written before `close`, so that no step waits for a
    disk; as a context manager it is closed at the end, and an exception leaves no file. A step costs a copy of its inputs and outputs.
    """

    def __init__(
        self,
        controller: _lads.Controller,
        path: str | os.PathLike[str],
        *,
        seed: int = 0,
        noise: str = "",
        notes: Mapping[str, str] | None = None,
    ) -> None:
        self.controller = controller
        _numbers.instance("path", path, (str, os.PathLike), "a str or a pathlib.Path")
        _numbers.instance("noise", noise, str, "a str")
        _numbers.instance("notes", {} if notes is None else notes, Mapping, "a dictionary of str")
        for text in (text for row in (notes or {}).items() for text in row):
            _numbers.instance("notes", text, str, "a dictionary of str")
        self.path = os.fspath(path)
        self._head = (_numbers.whole("seed", seed, 0, _numbers.SEED, RecordError), noise, dict(notes or {}))
        self._episodes: list[dict[str, Any]] = []
        self._steps: list[dict[str, Any]] = []
        _lads.check_log(controller.policy, self.path, *self._head)
        (self._channel,) = (channel.name for channel in controller.policy.contract.observations)
        self._drawn = {channel.name for channel in controller.policy.contract.channels if channel.role == "noise"}

    @property
    def policy(self) -> _lads.Policy:
        """The policy of the controller."""
        return self.controller.policy

    def step(self, observation: Any, out: np.ndarray | None = None) -> tuple[np.ndarray, _lads.StepReport]:
        """Runs the controller's `step` and records it."""
        named = observation if isinstance(observation, dict) else {self._channel: observation}
        if self._drawn & named.keys():
            raise RecordError("a recording does not hold noise that is given; leave it out, or give policy.controller(noise=), a seed")
        seen = np.array(named.get(self._channel)).ravel()  # now: `out` may be the same memory
        start = time.perf_counter_ns()
        action, report = self.controller.step(observation, out)
        spent = time.perf_counter_ns() - start
        selected = report.selected
        self._steps.append(
            {
                "observations": seen,
                "actions": np.array(action),
                "executed": np.array(action),
                "plans": selected and selected.index,
                "decided": bool(selected and selected.fresh),
                "margins": selected and selected.margin,
                "scores": self.controller.scores if selected and selected.fresh else [],
                "controller_ns": spent,
            }
        )
        return action, report

    def executed(self, action: np.ndarray) -> None:
        """Calls the controller's `executed` and records the action."""
        self.controller.executed(action)
        self._steps[-1]["executed"] = np.array(action)

    def reset(self) -> None:
        """Ends the episode, and starts a new one with the same instruction."""
        self.controller.reset()
        self.end()

    def instruct(self, instruction: Any) -> None:
        """Ends the episode, and sets the instruction to follow from the next step on."""
        self.end()
        self.controller.instruct(instruction)

    def end(self, success: bool = False, completions: Sequence[tuple[str, int]] = ()) -> None:
        """Ends the episode with its outcome: `success`, and sub-tasks with the first step, from 1, after which they were done."""
        completions = _completions(completions)
        if not self._steps:
            return
        told = self.controller._instruction
        sample, noise, _ = self.controller._settings
        columns = {key: [step[key] for step in self._steps] for key in self._steps[0]}
        for key in ("observations", "actions", "executed"):
            columns[key] = np.stack(columns[key])
        self._episodes.append(
            {
                **columns,
                "instruction": told if isinstance(told, str) else None,
                "words": None if told is None or isinstance(told, str) else np.ravel(told).tolist(),
                "sample": sample,
                "noise": noise,
                "success": bool(success),
                "completions": completions,
            }
        )
        self._steps = []

    def close(self) -> None:
        """Ends the episode and writes the file."""
        self.end()
        _lads.write_log(self.policy, self.path, *self._head, self._episodes)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self.close()


def _completions(given):
    """Returns pairs of a sub-task's name and a control step."""
    try:
        rows = [(str(name), step) for name, step in given]
    except (TypeError, ValueError) as error:
        raise RecordError(f"completions: it is no list of pairs ({error}); give [(name of a sub-task, control step), ...]") from None
    return [(name, _numbers.whole("completions", step, 0, _numbers.MOST, RecordError)) for name, step in rows]
