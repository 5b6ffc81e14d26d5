"""Control steps: the golden episodes of every form of policy, and everything that is refused."""

import os
import threading

import numpy as np
import pytest

import lads
from conftest import KINDS, busy, replay


@pytest.mark.parametrize("kind", KINDS)
def test_a_golden_episode_of_every_kind(bundles, kind):
    policy = lads.open(bundles[kind])
    golden = policy.golden
    controller = policy.controller(golden.instruction)
    assert np.abs(replay(controller, golden) - golden.actions).max() <= golden.tolerance
    if golden.instruction is None:
        controller.reset()
    else:
        controller.instruct(golden.instruction)
    assert np.abs(replay(controller, golden) - golden.actions).max() <= golden.tolerance, "again after a reset"


@pytest.mark.parametrize("kind", KINDS)
def test_warming_changes_nothing(bundles, kind):
    policy = lads.open(bundles[kind])
    golden = policy.golden
    controller = policy.controller(golden.instruction)
    controller.warm()
    for step in range(10):
        given = {name: values[step] for name, values in golden.observations.items()}
        if golden.noise.shape[1]:
            given["noise"] = golden.noise[step]
        action, report = controller.step(given)
        assert np.abs(action - golden.actions[step]).max() <= golden.tolerance and report.timestep == step
        controller.warm()
        assert np.array_equal(controller.last_action, action)


def test_channels_are_given_by_name(bundles):
    policy = lads.open(bundles["camera"])
    names = [channel.name for channel in policy.contract.observations]
    assert len(names) == 3 and {str(channel.dtype) for channel in policy.contract.observations} == {"float32", "uint8", "int32"}
    golden = policy.golden
    given = {name: golden.observations[name][0] for name in reversed(names)}
    action, report = policy.controller().step(given)
    assert np.abs(action - golden.actions[0]).max() <= golden.tolerance and report.selected is None
    for wrong, text in [
        ({names[0]: given[names[0]]}, f"channel `{names[1]}`, `{names[2]}` is not given"),
        ({**given, "lidar": given[names[0]]}, "no channel is called `lidar`"),
        ({**given, names[1]: given[names[1]].astype(np.float32)}, f"channel `{names[1]}`: its dtype is float32, the contract says uint8"),
        ({**given, names[1]: given[names[1]][:, ::-1]}, "not contiguous"),
        (given[names[0]], "a dictionary with the channels"),
    ]:
        with pytest.raises(lads.errors.InputError, match=text):
            policy.controller().step(wrong)


def test_an_action_is_written_in_place(plain, seen):
    controller = plain.controller()
    out = np.zeros(plain.contract.action.shape, np.float32)
    action, report = controller.step(seen, out)
    assert action is out and np.array_equal(out, plain.controller().step(seen)[0]) and report.timestep == 0
    assert np.array_equal(controller.last_action, out)
    # Where both share memory, the observation is read before the action is written.
    shared = seen.copy()
    action, _ = plain.controller().step(shared, shared[: len(out)])
    assert np.array_equal(action, out)


def test_kernels_have_the_same_bits(kitchen):
    golden = kitchen.golden
    fast, portable = (kitchen.controller(golden.instruction, portable=flag) for flag in (False, True))
    assert portable.isa == "portable"
    assert np.array_equal(replay(fast, golden), replay(portable, golden))


def test_what_a_step_reports(kitchen):
    golden = kitchen.golden
    controller = kitchen.controller(golden.instruction)
    reports = []
    for step in range(20):
        reports.append(controller.step(golden.observations["observation"][step])[1])
        controller.executed(golden.actions[step])
    assert [report.timestep for report in reports] == list(range(20))
    assert [report.selected.index for report in reports] == golden.selected[:20].tolist()
    fresh = [report.timestep for report in reports if report.selected.fresh]
    assert fresh[0] == 0 and len(fresh) in (1, 2) and reports[0].selected.margin > 0
    assert controller.scores.shape == (kitchen.contract.indices,) and "Selected(index=" in repr(reports[0])
    controller.reset()
    assert controller.step(golden.observations["observation"][0])[1] == reports[0]


def test_instructions(kitchen):
    known = kitchen.contract.instructions[0]
    controller = kitchen.controller()
    seen = kitchen.golden.observations["observation"][0]
    assert not controller.instructed and controller.instruction is None
    with pytest.raises(lads.errors.InstructionError, match="no instruction has been set"):
        controller.step(seen)
    controller.instruct(known.text.upper())
    assert controller.instruction == known.id
    rng = np.random.default_rng(0)
    words = rng.normal(size=(kitchen.contract.context.words, 384)).astype(np.float32)
    controller.instruct(words)
    assert controller.instruction is None and controller.instructed
    for wrong, text in [
        ("sing a song", "the policy does not know it; the nearest that it knows"),
        (words[:, :5].copy(), "the words have 5 elements each, the contract says 384"),
        (words[0], "give one of 2 dimensions"),
        (words[:, ::2], "array `instruction`: the array is not contiguous"),
        (np.ndarray(words.shape, np.float32, bytearray(words.nbytes + 1), 1), "array `instruction`: the array is not aligned"),
        (words.astype(float), "its dtype is float64"),
        (np.full_like(words, np.nan), "word element 0 is not finite"),
        (np.zeros((99, 384), np.float32), "an instruction of 99 words"),
        (7, "it is a int; give a numpy.ndarray"),
    ]:
        with pytest.raises(lads.errors.InstructionError, match=text):
            controller.instruct(wrong)
    assert controller.instructed, "a refused one changes nothing"


def test_a_policy_that_takes_no_instruction(plain):
    with pytest.raises(lads.errors.InstructionError, match="it knows no instructions, so give none"):
        plain.controller("go")


def test_an_index_of_ones_own(kitchen):
    seen = kitchen.golden.observations["observation"][0]
    controller = kitchen.controller(kitchen.golden.instruction)
    action, report = controller.step(seen)
    assert np.array_equal(controller.follow(seen, report.selected.index), action)
    assert not np.array_equal(controller.follow(seen, (report.selected.index + 1) % kitchen.contract.indices), action)
    with pytest.raises(lads.errors.StepError, match="index 40 of 40"):
        controller.follow(seen, 40)


def test_sampling_and_noise_have_seeds(kitchen, bundles):
    seen = kitchen.golden.observations["observation"]

    def indices(seed):
        controller = kitchen.controller(kitchen.golden.instruction, sample=seed)
        assert controller.decision == "sample"
        return [controller.step(row)[1].selected.index for row in seen]

    assert indices(1) == indices(1) and len({tuple(indices(seed)) for seed in range(8)}) > 1
    policy = lads.open(bundles["skilldiffuser"])
    first = {name: values[0] for name, values in policy.golden.observations.items()}
    action = lambda seed: policy.controller(policy.golden.instruction, noise=seed).step(first)[0]
    assert np.array_equal(action(1), action(1)) and not np.array_equal(action(1), action(2))


def wrong_arrays(seen):
    read_only = np.zeros(3, np.float32)
    read_only.flags.writeable = False
    unaligned = np.ndarray(seen.shape, np.float32, bytearray(seen.nbytes + 1), 1)
    return [
        ((seen.astype(np.float64),), "channel `observation`: its dtype is float64, the contract says float32"),
        ((seen.astype(">f4"),), "its dtype is >f4"),
        ((seen.astype(object),), "its dtype is object"),
        ((seen[:3],), r"its shape is \(3,\), the contract says \(8,\)"),
        ((seen[None],), r"its shape is \(1, 8\)"),
        ((seen[0],), "it is a|is a float32; give an array"),
        ((np.repeat(seen, 2)[::2],), "not contiguous"),
        ((np.broadcast_to(seen[0], 8),), "not contiguous"),
        ((unaligned,), "not aligned"),
        ((list(seen),), "the observation is a list; give an array"),
        ((None,), "the observation is a NoneType"),
        (({},), "channel `observation` is not given"),
        (({1: seen},), "no channel is called `1`"),
        ((np.where(np.arange(8) == 2, np.nan, seen).astype(np.float32),), "channel `observation`, element 2 `joint3` is not finite"),
        ((np.where(np.arange(8) == 1, np.inf, seen).astype(np.float32),), "element 1 `joint2` is not finite"),
        ((np.full(8, 1e9, np.float32),), "element 0 `joint1` is 1000000000, its limits are"),
        ((seen, read_only), "out `action`: the array is read-only"),
        ((seen, np.zeros(4, np.float32)), r"out `action`: its shape is \(4,\)"),
        ((seen, np.zeros(3)), "out `action`: its dtype is float64"),
        ((seen, np.zeros(6, np.float32)[::2]), "not contiguous"),
        ((seen, [0, 0, 0]), "out `action`: it is a list"),
    ]


def test_wrong_arrays_are_named_and_change_nothing(bundles):
    policy = lads.open(bundles["recurrent"])
    golden = policy.golden
    rows = golden.observations["observation"]
    spoiled = policy.controller()
    for step in range(5):
        spoiled.step(rows[step])
    for arguments, text in wrong_arrays(rows[5].copy()):
        with pytest.raises(lads.errors.InputError, match=text):
            spoiled.step(*arguments)
    assert np.abs(spoiled.step(rows[5])[0] - golden.actions[5]).max() <= golden.tolerance


def test_what_was_executed(kitchen):
    controller = kitchen.controller(kitchen.golden.instruction)
    done = np.zeros(9, np.float32)
    with pytest.raises(lads.errors.StepError, match="no step has been taken yet"):
        controller.executed(done)
    controller.step(kitchen.golden.observations["observation"][0])
    controller.executed(done)
    assert np.array_equal(controller.last_action, done)
    with pytest.raises(lads.errors.InputError, match="not finite"):
        controller.executed(done * np.nan)


def test_use_after_close(plain, seen):
    with plain.controller() as controller:
        controller.warm()
        assert not controller.closed
    assert controller.closed
    for call in (lambda: controller.step(seen), controller.reset, lambda: controller.scores, lambda: controller.instruct("x"), controller.warm):
        with pytest.raises(lads.errors.ClosedError, match="the controller is closed"):
            call()
    controller.close()


def test_one_controller_and_two_threads(kitchen):
    seen = kitchen.golden.observations["observation"][0]
    controller = kitchen.controller(kitchen.golden.instruction)
    refused, steps = busy(lambda: controller.step(seen), 4)
    assert "the controller is at work in another thread" in refused and steps
    controller.reset()
    assert controller.step(seen)[1].timestep == 0, "it still works"


def test_threads_with_controllers_of_their_own(kitchen):
    golden = kitchen.golden
    found = {}

    def work(name):
        found[name] = replay(kitchen.controller(golden.instruction), golden)

    threads = [threading.Thread(target=work, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4 and all(np.array_equal(found[0], other) for other in found.values())


def test_a_fork_in_the_middle(kitchen):
    seen = kitchen.golden.observations["observation"][0]
    controller = kitchen.controller(kitchen.golden.instruction)
    batch = lads.vector.Controllers(kitchen, 2, kitchen.golden.instruction, threads=2)
    action, _ = controller.step(seen)
    batch.step(np.stack([seen, seen]))
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            said = []
            for call in (lambda: controller.step(seen), controller.close, lambda: batch.step(np.stack([seen, seen]))):
                try:
                    call()
                except lads.errors.ForkError as error:
                    said.append(str(error))
            fresh = kitchen.controller(kitchen.golden.instruction)
            same = np.array_equal(fresh.step(seen)[0], action)
            del batch
            os.write(write, f"{len(said)} {same} {said[0]}; {said[2]}".encode())
        finally:
            os._exit(0)
    os.close(write)
    said = b"".join(iter(lambda: os.read(read, 4096), b"")).decode()
    _, status = os.waitpid(child, 0)
    assert status == 0 and said.startswith("3 True the controller was made before this process was forked"), said
    assert said.endswith("the batch of controllers was made before this process was forked, and belongs to the other one; make one here, by lads.vector.Controllers(policy, ...)")
    controller.reset()
    assert np.array_equal(controller.step(seen)[0], action), "the parent goes on"


def test_a_full_context_is_refused_or_restarts(kitchen):
    seen = kitchen.golden.observations["observation"][0]
    controller = kitchen.controller(kitchen.golden.instruction)
    timesteps = [controller.step(seen)[1].timestep for _ in range(2 * kitchen.contract.context.steps)]
    assert max(timesteps) < kitchen.contract.context.steps and timesteps.count(0) == 2


def resident():
    """Returns the number of bytes of this process's memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_nothing_leaks(plain, seen):
    out = np.zeros(3, np.float32)

    def round_of(controllers):
        for _ in range(controllers):
            controller = plain.controller()
            controller.step(seen, out)
            try:
                controller.step(seen[:2])
            except lads.errors.InputError:
                pass

    round_of(1000)
    before = resident()
    round_of(100_000)
    assert resident() - before < 4 << 20
