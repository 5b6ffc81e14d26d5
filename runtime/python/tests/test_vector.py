"""Batches of controllers over threads: the same bits as one after the other."""

import sys
import time
from pathlib import Path

import numpy as np
import pytest

import lads
from conftest import busy, replay
from lads.vector import Controllers


def test_a_batch_is_as_many_controllers(kitchen):
    golden = kitchen.golden
    rows = golden.observations["observation"]
    instructions = [row.id for row in kitchen.contract.instructions[:5]]
    alone = [kitchen.controller(instruction) for instruction in instructions]
    with Controllers(kitchen, 5, instructions, threads=2) as batch:
        assert len(batch) == 5 and batch.threads == 2
        out = np.zeros((5, 9), np.float32)
        for step in range(30):
            seen = np.stack([rows[(step + row) % len(rows)] for row in range(5)])
            actions, report = batch.step(seen, out)
            found = [controller.step(row) for controller, row in zip(alone, seen)]
            assert actions is out and np.array_equal(out, np.stack([action for action, _ in found]))
            assert report.timestep.tolist() == [one.timestep for _, one in found]
            assert report.index.tolist() == [one.selected.index for _, one in found]
            assert report.fresh.tolist() == [one.selected.fresh for _, one in found]
            done = out * 0.5
            batch.executed(done)
            for controller, row in zip(alone, done):
                controller.executed(row)
        batch.reset([1, 3])
        assert batch.step(seen)[1].timestep.tolist() == [30, 0, 30, 0, 30]
        batch.instruct(instructions[0], [4])
        assert batch.step(seen)[1].timestep.tolist() == [31, 1, 31, 1, 0]
    with pytest.raises(lads.errors.ClosedError):
        batch.step(seen)


def test_several_channels(bundles):
    policy = lads.open(bundles["camera"])
    golden = policy.golden
    batch = Controllers(policy, 3)
    given = {name: np.ascontiguousarray(values[:3]) for name, values in golden.observations.items()}
    actions, report = batch.step(given)
    assert np.abs(actions - golden.actions[:3]).max() <= golden.tolerance and report.index is None


def test_one_refused_observation_leaves_all_as_they_were(bundles):
    policy = lads.open(bundles["recurrent"])
    rows = policy.golden.observations["observation"]
    batch, single = Controllers(policy, 3, threads=2), policy.controller()
    seen = np.repeat(rows[:1], 3, 0)
    batch.step(seen)
    single.step(rows[0])
    wrong = np.repeat(rows[1:2], 3, 0)
    wrong[1, 2] = np.nan
    wrong[2, 0] = 1e9
    with pytest.raises(lads.errors.InputError, match="row 1: channel `observation`, element 2 `joint3` is not finite, row 2: .*1000000000"):
        batch.step(wrong)
    actions, _ = batch.step(np.repeat(rows[1:2], 3, 0))
    assert np.array_equal(actions, np.repeat(single.step(rows[1])[0][None], 3, 0))


def test_seeds_of_the_rows(kitchen):
    rows = kitchen.golden.observations["observation"]
    batch = Controllers(kitchen, 3, kitchen.golden.instruction, sample=7)
    alone = [replay(kitchen.controller(kitchen.golden.instruction, sample=7 + row), kitchen.golden) for row in range(3)]
    for step, seen in enumerate(rows):
        actions, _ = batch.step(np.stack([seen] * 3))
        assert np.array_equal(actions, np.stack([one[step] for one in alone]))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0,), "count is 0; give 1 or more"),
        ((2, ["kbls"]), "1 instructions for 2 rows"),
        ((2, "sing"), "the policy does not know it"),
    ],
)
def test_batches_that_make_no_sense(kitchen, arguments, text):
    with pytest.raises(lads.LadsError, match=text):
        Controllers(kitchen, *arguments)
    with pytest.raises(lads.errors.InputError, match="row 5: the batch has 2"):
        Controllers(kitchen, 2).reset([5])
    with pytest.raises(lads.errors.InstructionError, match="rows 0, 1: no instruction has been set"):
        Controllers(kitchen, 2).step(np.stack([kitchen.golden.observations["observation"][0]] * 2))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc lists a process's threads on Linux alone")
def test_a_closed_batch_has_no_threads(plain, seen):
    running = lambda: {path.name for path in Path("/proc/self/task").iterdir()}
    before = running()
    batch = Controllers(plain, 3, threads=3)
    batch.step(np.stack([seen] * 3))
    own = running() - before
    assert len(own) == 2, "the caller's is the third"
    batch.close()
    deadline = time.monotonic() + 60
    while running() & own and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not running() & own and batch.threads == 3


def test_never_more_threads_than_controllers(plain):
    assert Controllers(plain, 2, threads=10**9).threads == 2 and Controllers(plain, 1).threads == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda seen: seen.astype(np.float64), "its dtype is float64"),
        (lambda seen: seen[:1], r"its shape is \(1, 8\), the contract says \(2, 8\)"),
        (lambda seen: seen[0], r"its shape is \(8,\)"),
        (lambda seen: np.asfortranarray(seen), "not contiguous"),
        (lambda seen: seen.tolist(), "the observation is a list"),
    ],
)
def test_wrong_arrays_are_named(plain, seen, change, text):
    batch = Controllers(plain, 2)
    with pytest.raises(lads.errors.InputError, match=text):
        batch.step(change(np.stack([seen, seen])))
    read_only = np.zeros((2, 3), np.float32)
    read_only.flags.writeable = False
    with pytest.raises(lads.errors.InputError, match="out `actions`: the array is read-only"):
        batch.step(np.stack([seen, seen]), read_only)
    with pytest.raises(lads.errors.StepError, match="no step has been taken yet"):
        batch.executed(np.zeros((2, 3), np.float32))
    batch.step(np.stack([seen, seen]))
    with pytest.raises(lads.errors.InputError, match="not finite"):
        batch.executed(np.full((2, 3), np.nan, np.float32))


def test_one_batch_and_two_threads(kitchen):
    seen = np.repeat(kitchen.golden.observations["observation"][:1], 8, 0)
    batch = Controllers(kitchen, 8, kitchen.golden.instruction, threads=1)
    refused, _ = busy(lambda: batch.step(seen), 2)
    assert "the batch is at work in another thread" in refused
    batch.reset()
    assert batch.step(seen)[1].timestep.tolist() == [0] * 8
