"""Every public function with every kind of wrong number, sequence and text: an exception that is typed and names the argument, or an answer."""

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

import lads
from conftest import PROJECT
from environments import Servo
from lads import gym
from lads.language import Encoder
from lads.rollout import episode_seed
from lads.vector import Controllers

NOT_WHOLE = [1.0, 2.5, math.nan, math.inf, "3", b"3", None, True, np.True_, np.float32(2), [1], (), {}, 1j, object()]
BELOW = [-1, -(2**31), -(2**63), -(2**64), -(10**400), np.int8(-1), np.int64(-5)]
ABOVE = [2**64, 2**70, 10**400, 10**9999]
SEED = [*(value for value in NOT_WHOLE if value is not None), *BELOW, *ABOVE]
COUNT = [*NOT_WHOLE, 0, *BELOW, *ABOVE, 10**9, 2**32, 2**63, np.uint64(2**64 - 1)]


def shown(value):
    """Names a value alike in every process, which workers that share the tests compare."""
    if type(value) is object:
        return "object"
    return f"{type(value).__name__}-{value!r}"[:40] if not (type(value) is int and abs(value) > 10**40) else f"int-{'-' if value < 0 else ''}huge"


def each(**wrong):
    """Parameters of a test: one for each argument's name and each of its wrong values."""
    rows = [(name, value) for name, values in wrong.items() for value in values]
    return pytest.mark.parametrize(("name", "value"), rows, ids=[f"{name}-{shown(value)}" for name, value in rows])


def refused(call, name):
    """Asserts that a call is refused by a typed exception that names the argument, in a line that can be read."""
    with pytest.raises((lads.LadsError, TypeError)) as error:
        call()
    text = "\n".join([str(error.value), *getattr(error.value, "__notes__", [])])
    assert name in text and len(text) < 600, text


@each(count=COUNT, threads=[value for value in COUNT if value is not None and not (type(value) in (int, np.uint64) and value > 0)], sample=SEED, noise=SEED)
def test_a_batch(plain, name, value):
    refused(lambda: Controllers(plain, **{"count": 2, name: value}), name)


def test_a_batch_that_no_machine_has_memory_for(plain):
    for count in (10**9, 2**62):
        with pytest.raises(ValueError, match=rf"count: {count} controllers take [\d.]+ [TPEZ]iB, [\d.]+ [KM]iB each, .* give at most \d+"):
            Controllers(plain, count)


NO_ROWS = [5, 1.5, "01", b"\1", [True], [False, True], [-1], [2], [2**70], [10**400], [0.0], ["0"], [None], [[0]], np.array([True, False]), np.array([0.0]), np.array([[0, 1]]), np.array([-1])]


@each(rows=[*NO_ROWS, itertools.count(), {0: 1}.keys])
def test_rows_of_a_batch(plain, kitchen, name, value):
    refused(lambda: Controllers(plain, 2).reset(value), name[:3])
    refused(lambda: Controllers(kitchen, 2).instruct("kbls", value), name[:3])


def test_numbers_of_numpy(plain, seen):
    batch = Controllers(plain, np.int64(3), threads=np.uint8(2), sample=np.uint64(2**64 - 1))
    assert len(batch) == 3 and batch.threads == 2
    seen = np.stack([seen] * 3)
    for rows, timesteps in [
        (np.array([0, 2]), [0, 1, 0]),
        ((np.int32(1),), [1, 0, 1]),
        ([], [2, 1, 2]),
        (np.flatnonzero([False] * 3), [3, 2, 3]),
        (range(1), [0, 3, 4]),
        ({1, 2}, [1, 0, 0]),
        (None, [0, 0, 0]),
    ]:
        if timesteps == [0, 1, 0]:
            batch.step(seen)
        batch.reset(rows)
        assert batch.step(seen)[1].timestep.tolist() == timesteps
    assert plain.controller(sample=np.int8(3), noise=np.uint64(2**64 - 1))._settings[:2] == (3, 2**64 - 1)
    assert gym.Rate(np.int64(3), np.uint8(10)).rate == 0.3 and episode_seed(np.int32(2), np.uint64(5)) == episode_seed(2, 5)


@each(sample=SEED, noise=SEED, portable=[1, "yes", None, 0.0])
def test_a_controller(plain, name, value):
    refused(lambda: plain.controller(**{name: value}), name)


@each(index=[*NOT_WHOLE, *BELOW, *ABOVE, 40, 2**32, 2**63])
def test_an_index(kitchen, name, value):
    seen = kitchen.golden.observations["observation"][0]
    controller = kitchen.controller(kitchen.golden.instruction)
    refused(lambda: controller.follow(seen, value), name)


@each(
    tolerance=["x", [1], True, np.True_, math.nan, math.inf, -math.inf, 0, -1, 1e-60, 1e300, 10**400, 1j],
    weights=[1, b"f32", ["f32"], "F32", "", "f32\0", "x" * 10**6],
    low_level=[1, "f8"],
    cache=[1.5, "bf16"],
    force=[1, "yes", None],
)
def test_opening(kitchen, name, value):
    refused(lambda: lads.open(kitchen.path, **{name: value}), name)


@each(path=[None, 7, 1.5, b"kitchen", ["kitchen"], True])
def test_a_path(kitchen, name, value):
    refused(lambda: lads.open(value), name)
    refused(lambda: lads.from_image(kitchen.image, value), name)
    for call in (lads.import_onnx, lads.template):
        refused(lambda: call(value), "policy" if value != ["kitchen"] else "kitchen")


LETTERS = ["x" * 10**6, "open the drawer " * 10**5, " " * 10**6, "é" * 10**6, "", "\0", "\ud800", "a\nb"]


@pytest.mark.parametrize("text", LETTERS, ids=range(len(LETTERS)))
def test_a_sentence_that_nobody_says(kitchen, text):
    controller = kitchen.controller()
    for call in (controller.instruct, kitchen.words, kitchen.controller, lambda text: Controllers(kitchen, 2, text), lambda text: Controllers(kitchen, 2).instruct([text] * 2)):
        refused(lambda: call(text), "instruction")


def test_a_sentence_that_no_tokeniser_sees():
    encoder = Encoder.__new__(Encoder)  # without its engines, which are not asked
    for text in (text for text in LETTERS if len(text) > 10**5):
        with pytest.raises(lads.errors.LanguageError, match=r"…': a sentence of \d+ letters; .* use fewer words"):
            encoder.words(text)


@each(policy=[None, 5, "kitchen", lads.open])
def test_an_encoder_of_no_policy(name, value):
    refused(lambda: Encoder(value), name)


NO_WORDS = [7, -1, math.nan, True, b"kbls", ["kbls"], {}, np.float32(1), np.zeros((0, 384), np.float32), np.zeros((1, 0), np.float32), np.zeros((10**6, 0), np.float32), np.zeros((2, 384), int), np.array(["kbls"])]
NO_WORDS += [np.broadcast_to(np.float32(1), (10**12, 384)), np.zeros((10**5, 384), np.float32), np.zeros((1, 1, 384), np.float32), np.ma.masked_array(np.zeros((1, 384), np.float32), True)[:, ::2]]


@pytest.mark.parametrize("words", NO_WORDS, ids=range(len(NO_WORDS)))
def test_words_that_are_none(kitchen, words):
    for call in (kitchen.controller().instruct, kitchen.nearest, kitchen.controller):
        with pytest.raises((lads.errors.InstructionError, TypeError)) as error:
            call(words)
        assert len(str(error.value)) < 500


@each(
    episodes=[*NOT_WHOLE, 0, *BELOW, *ABOVE],
    seed=[*NOT_WHOLE, *BELOW],
    processes=[*NOT_WHOLE, 0, *BELOW, *ABOVE],
    max_steps=[*(value for value in NOT_WHOLE if value is not None), 0, *BELOW],
)
def test_an_evaluation(plain, name, value):
    refused(lambda: gym.evaluate(plain.controller(), Servo, **{"episodes": 1, "max_steps": 2, "progress": False, name: value}), name)


@each(
    episodes=[*NOT_WHOLE, 0, *BELOW, *ABOVE],
    traced=[*NOT_WHOLE, 0, *BELOW],
    seed=[*NOT_WHOLE, *BELOW, *ABOVE],
    max_steps=[*(value for value in NOT_WHOLE if value is not None), 0, *BELOW],
    control_period=["0.02", math.nan, math.inf, 0, -0.1, True, np.True_, [0.02], 1j, 10**400],
)
def test_a_verification(plain, name, value):
    controller = plain.controller()
    refused(lambda: lads.verify(lambda seen: controller.step(seen)[0], controller, Servo, **{"episodes": 1, "max_steps": 2, "progress": False, name: value}), name)


@each(count=[*NOT_WHOLE, *BELOW, *ABOVE, 11], episodes=[*NOT_WHOLE, 0, *BELOW, *ABOVE])
def test_a_rate(name, value):
    refused(lambda: gym.Rate(**{"count": 3, "episodes": 10, name: value}), name)


@each(seed=SEED)
def test_a_recording(plain, tmp_path, name, value):
    refused(lambda: lads.Recorder(plain.controller(), tmp_path / "a.mcap", seed=value), name)


@each(path=[None, 7, True, ["a"]], notes=[5, "ab", [("a", "b")], {"a": 1}, {1: "a"}], noise=[None, 5, b"x"])
def test_a_recording_without_sense(plain, tmp_path, name, value):
    refused(lambda: lads.Recorder(plain.controller(), **{"path": tmp_path / "a.mcap", name: value}), name)


@each(controller=[None, 5, "kbls"], make_env=["FrankaKitchen-v1", None, 5, Servo()], observation=[5], action=["x"], sub_tasks=["kettle", b"k", 5])
def test_objects_of_another_kind(plain, name, value):
    refused(lambda: gym.evaluate(**{"controller": plain.controller(), "make_env": Servo, "episodes": 1, "progress": False, name: value}), name)
    arguments = {"reference": lambda seen: 0, "controller": plain.controller(), "make_env": Servo, "episodes": 1, "progress": False, name: value}
    refused(lambda: lads.verify(**arguments), name)


@each(reference=[None, 5], state=["x"], instructions=["kbls", [], 5], sub_tasks=[{"other": ["a"]}])
def test_a_verification_of_another_kind(plain, name, value):
    arguments = {"reference": lambda seen: 0, "controller": plain.controller(), "make_env": Servo, "episodes": 1, "progress": False, name: value}
    refused(lambda: lads.verify(**arguments), name)


@pytest.mark.parametrize("completions", [[("a", -1)], [("a", 2**64)], [("a", 1.5)], [("a", True)], [("a",)], [5], "ab", 3, [("a", math.nan)]], ids=str)
def test_completions_of_a_recording(plain, seen, tmp_path, completions):
    recorder = lads.Recorder(plain.controller(), tmp_path / "a.mcap")
    recorder.step(seen)
    refused(lambda: recorder.end(True, completions), "completions")
    recorder.end(True, [("a", np.int64(1))])
    recorder.close()
    assert (tmp_path / "a.mcap").stat().st_size > 0


@each(seed=[*NOT_WHOLE, *BELOW], episode=[*NOT_WHOLE, *BELOW])
def test_the_seed_of_an_episode(name, value):
    refused(lambda: episode_seed(**{"seed": 0, "episode": 0, name: value}), name)


NO_OBSERVATIONS = [0, -1, 10**400, math.nan, True, "x", b"x", [], (1,), [math.nan] * 8, np.float32(1), np.zeros(8, bool), np.zeros(8, int), np.zeros(0, np.float32), np.array(1, np.float32), np.array(["a"] * 8), object()]
NO_OBSERVATIONS += [np.broadcast_to(np.float32(1), (10**12,)), {"observation": 3}, {"observation": None}, {None: 1}, {10**400: 1}, {"o" * 10**6: 1}, {"observation": {}}]


@pytest.mark.parametrize("given", NO_OBSERVATIONS, ids=range(len(NO_OBSERVATIONS)))
def test_observations_that_are_none(plain, seen, given):
    controller, batch = plain.controller(), Controllers(plain, 1)
    out = np.zeros(plain.contract.action.shape, np.float32)
    before = controller.step(seen)[0]
    for call in (controller.step, batch.step, lambda given: controller.follow(given, 0)):
        refused(lambda: call(given), "observation")
    for call in (controller.executed, batch.executed):
        refused(lambda: call(given), "executed")
    for call in (lambda given: controller.step(seen, given), lambda given: batch.step(seen[None], given)):
        refused(lambda: call(given), "out")
    assert np.array_equal(controller.step(seen, out)[0], before)


def test_no_number_ends_the_process():
    """The longest run of all, in a process of its own: what is refused in the tests above leaves an interpreter that works."""
    code = "import lads, numpy as np\nfrom lads.vector import Controllers\np = lads.open('models/kitchen-small.onnx')\n"
    code += "for n in (-1, 0, 10**9, 2**40, 10**30):\n    try:\n        Controllers(p, n)\n    except ValueError as error:\n        print('refused', str(error)[:5])"
    done = subprocess.run([sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.split("\n")[:5] == ["refused count"] * 5, done.stderr
