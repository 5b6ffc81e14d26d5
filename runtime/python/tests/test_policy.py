"""Tests opening and inspecting policies."""

import dataclasses
import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

import lads
from conftest import PROJECT


def test_a_policy_says_what_it_expects(kitchen):
    contract = kitchen.contract
    assert contract.family == "lads" and contract.environment == "franka-kitchen"
    assert contract.control_period == 0.08 and contract.indices == 40
    (observation,) = contract.observations
    assert observation.shape == (30,) and observation.dtype == np.float32
    assert observation.elements[0].name == "panda_joint1" and observation.elements[0].unit == "rad"
    assert contract.action.shape == (9,) and contract.action.role == "action"
    assert {row.id for row in contract.instructions} >= {"kbls", "mbts"} and contract.language.dim == 384
    with pytest.raises(dataclasses.FrozenInstanceError):
        contract.family = "other"
    assert kitchen.contract is contract, "read once"


def test_the_report_is_the_commands(kitchen):
    command = subprocess.run([sys.executable, "-m", "lads", "inspect", "--json", kitchen.path], check=True, capture_output=True, text=True)
    assert kitchen.inspect() == json.loads(command.stdout)


def test_the_self_test_is_the_commands(kitchen):
    found = kitchen.self_test()
    command = subprocess.run([sys.executable, "-m", "lads", "self-test", kitchen.path], check=True, capture_output=True, text=True)
    assert found.steps == 50 and found.largest_error < found.tolerance
    assert f"digest {found.digest}" in command.stdout


def test_the_command_refuses_with_2():
    command = subprocess.run([sys.executable, "-m", "lads", "inspect", "nowhere.onnx"], capture_output=True, text=True)
    assert command.returncode == 2 and command.stderr.startswith("error: nowhere.onnx: ")


def test_an_image_is_the_same_policy(kitchen, tmp_path):
    path = tmp_path / "kitchen.lads"
    path.write_bytes(kitchen.image)
    image = lads.open(path)
    assert image.contract == kitchen.contract and image.self_test() == kitchen.self_test()
    again = pickle.loads(pickle.dumps(kitchen))
    assert again.image == kitchen.image and again.path == kitchen.path


def test_it_is_compiled_as_asked(kitchen, tmp_path):
    half = lads.open(kitchen.path, weights="f16", cache="f16", tolerance=0.05)
    exact = lads.open(kitchen.path, weights="f32")
    assert exact.inspect()["stored"] == "f32 weights, f32 cache"
    # Left alone it is as it was tuned.
    assert len(half.image) < 0.7 * len(exact.image) and len(kitchen.image) < 0.9 * len(exact.image)
    assert kitchen.inspect()["stored"] == "f32 and int16 and int8 weights, f16 cache"
    assert half.inspect()["stored"] == "f16 weights, f16 cache" and half.self_test().tolerance == pytest.approx(0.05)
    integers = lads.open(kitchen.path, weights="f32", cache="int8")
    assert integers.inspect()["stored"] == "f32 weights, int8 cache" and integers.self_test().largest_error <= 1e-4
    mixed = lads.open(kitchen.path, weights="int16", low_level="f32")
    assert "int16" in mixed.inspect()["stored"]
    (tmp_path / "kitchen.lads").write_bytes(kitchen.image)
    with pytest.raises(lads.errors.OpenError, match="a compiled image already; give the bundle"):
        lads.open(tmp_path / "kitchen.lads", weights="f16")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"weights": "f8"}, "weights 'f8': no such format; known are f32"),
        ({"cache": "int4"}, "cache 'int4': no such format; known are f32, f16, int8"),
        ({"tolerance": float("nan")}, "tolerance: it has to be a positive number"),
    ],
)
def test_options_that_make_no_sense(kitchen, options, text):
    with pytest.raises(lads.errors.OpenError, match=text):
        lads.open(kitchen.path, **options)


def test_fewer_bits_than_the_gate_admits(kitchen):
    with pytest.raises(lads.errors.CompileError, match="tolerance"):
        lads.open(kitchen.path, weights="int8", tolerance=1e-9)


def test_files_that_are_no_policy(tmp_path, kitchen):
    (tmp_path / "text.onnx").write_text("no model")
    broken = bytearray(kitchen.image)
    broken[-1] ^= 1
    (tmp_path / "broken.lads").write_bytes(broken)
    for name, text in [("missing.onnx", "No such file"), ("text.onnx", "not an ONNX model"), ("broken.lads", "its checksum does not match"), (".", "it is a folder")]:
        with pytest.raises(lads.errors.OpenError) as error:
            lads.open(tmp_path / name)
        assert text in str(error.value) and str(tmp_path) in str(error.value)
    with pytest.raises(TypeError):
        lads.open(7)
    assert issubclass(lads.errors.OpenError, lads.LadsError) and issubclass(lads.errors.OpenError, ValueError)


def test_every_exception_has_one_root():
    found = [value for value in vars(lads.errors).values() if isinstance(value, type)]
    assert len(found) > 10 and all(issubclass(value, lads.LadsError) and value.__doc__ for value in found)


def test_shipped_policies_open():
    for path in sorted((PROJECT / "models").glob("*.onnx")):
        policy = lads.open(os.fspath(path))
        assert policy.self_test().largest_error <= policy.golden.tolerance
