"""Records a long made-up episode of a bundle and what its twin did, as a file that a test of another runtime replays.

One safetensors file, T control steps; every tensor is of T rows:

| tensor | type | what |
|---|---|---|
| `channel.<name>` [T, ...] | the channel's | every observation channel |
| `event` [T] | i64 | what happens before the step: -1 nothing, k >= 0 instruction k is set, -2 reset |
| `selected` [T] | i64 | the selected index in force after the step, -1 where nothing is selected |
| `actions` [T, A] | f32 | the action, clipped to its limits, and executed |
| `noise` [T, N] | f32 | only of policies with a noise channel: all draws of the step in order, then zeros |
| `draws` [T] | i64 | only with `noise`: how many numbers of the row were drawn |

Metadata: `kind`, `seed`, `margin` (the smallest lead of a selected over the second best index), `sha256` of the bundle. The noise is what the
contract's seed gives, so a runtime may draw its own and compare, or be fed. Instructions are set at the first step, in the middle of a context and
near the end, a reset stands between; contexts start anew on the way where the policy has one.
"""

import hashlib
from pathlib import Path

import numpy as np
import onnx
from safetensors.numpy import save as save_safetensors

from . import contract as contracts, random_policy, twin
from .config import UserError
from .output import write_atomically

NOTHING, RESET = -1, -2
MARGIN = 1e-3  # of the selections, so that rounding cannot change one
TRIES = 60


def events(contract, steps):
    """Makes the events [T] of an episode: two instructions by turns, and resets."""
    found = np.full(steps, NOTHING, np.int64)
    turns = (0, int(0.33 * steps), int(0.64 * steps), int(0.93 * steps))
    known = len(contract.get("instructions", []))
    for turn, event in zip(turns, (0, min(1, known - 1), RESET, 0) if known else (NOTHING, RESET, RESET, NOTHING), strict=True):
        found[turn] = event
    return found


def play(model, channels, happens, noise=None):
    """Runs the twin over an episode -> Rollout."""
    runner = twin.Twin(model, noise)
    rollout = twin.Rollout(runner)
    for t, event in enumerate(happens):
        if event == RESET:
            runner.reset()
        elif event >= 0:
            runner.set_instruction(int(event))
        rollout.step({name: rows[t] for name, rows in channels.items()})
    return rollout


def tensors(model, steps, seed):
    """Makes the tensors of an episode whose selections are all clear -> tensors, its smallest margin."""
    contract = contracts.of(model)
    happens = events(contract, steps)
    best = 0.0
    for tried in range(TRIES):
        channels = random_policy.channels(contract, steps, 1000 * seed + tried)
        rollout = play(model, channels, happens)
        if rollout.margin >= MARGIN:
            found = {f"channel.{name}": rows for name, rows in channels.items()}
            found |= {"event": happens, "selected": np.array(rollout.selected, np.int64)} | rollout.tensors()
            if "noise" in found:
                found["draws"] = np.array([len(row) for row in rollout.draws], np.int64)
            return found, rollout.margin
        best = max(best, rollout.margin)
    raise UserError(f"none of {TRIES} episodes of {steps} steps selects with a margin of {MARGIN} throughout (best {best:.6f})")


def write(path, output, steps=200, seed=0):
    """Writes the episode of the bundle at `path` to `output` -> its smallest margin."""
    data = Path(path).read_bytes()
    try:
        model = onnx.load_from_string(data)
    except Exception as error:
        raise UserError(f"{path}: no ONNX file ({type(error).__name__})") from error
    if steps < 20:
        raise UserError(f"--steps {steps}: at least 20 are needed for all that happens in an episode")
    found, margin = tensors(model, steps, seed)
    kind = contracts.of(model)["family"]["kind"]
    metadata = {"kind": kind, "seed": str(seed), "margin": f"{margin:.6f}", "sha256": hashlib.sha256(data).hexdigest()}
    write_atomically(output, save_safetensors(found, metadata=metadata))
    return margin
