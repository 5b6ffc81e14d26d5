"""Tests importing any ONNX policy: PyTorch's exports, compared with PyTorch, and everything that is refused."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

import lads
from conftest import PROJECT

HEAD = 'environment = { id = "bench", version = "1" }\ncontrol_period_s = 0.02\n'
SEEN = '[[term]]\nname = "{}"\nwidth = {}\nunit = "1"\nmin = -3\nmax = 3\n{}'
DONE = '[action]\nelements = ["left", "right"]\nunit = "rad"\nscale = 0.5\noffset = [0.1, -0.1]\nmin = -9\nmax = 9\n'
MEAN, STD = [0.1, -0.2, 0.3, 0.0, 0.5], [0.5, 1.0, 2.0, 0.8, 1.5]


class Recurrent(nn.Module):
    """A GRU whose state the caller carries."""

    def __init__(self):
        super().__init__()
        self.gru, self.last = nn.GRU(5, 8), nn.Linear(8, 2)

    def forward(self, obs, h_in):
        x, h_out = self.gru(obs[None], h_in)
        return self.last(x[0]), h_out


def exported(module, inputs, names, outputs, path):
    """Writes a module as ONNX -> the module."""
    torch.onnx.export(module.eval(), inputs, path, input_names=names, output_names=outputs, opset_version=17, dynamo=False)
    return module


@pytest.fixture
def actor(tmp_path):
    """A network whose normaliser is not in the graph, and its file."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(5, 16), nn.ELU(), nn.Linear(16, 2))
    return exported(network, (torch.zeros(1, 5),), ["obs"], ["actions"], tmp_path / "actor.onnx"), tmp_path / "actor.onnx"


@pytest.fixture
def robot(tmp_path):
    """Writes a person's description of the robot, with the normaliser."""
    path = tmp_path / "robot.toml"
    path.write_text(HEAD + SEEN.format("state", 5, f"offset = {MEAN}\nscale = {[1 / std for std in STD]}\n") + DONE)
    return path


def test_raw_values_in_and_targets_out(actor, robot):
    network, path = actor
    policy = lads.import_onnx(path, robot)
    assert policy.contract.environment == "bench" and policy.contract.control_period == pytest.approx(0.02)
    assert [element.name for element in policy.contract.action.elements] == ["left", "right"]
    assert policy.path == str(path) and any("double-precision evaluation" in note for note in policy.notes)
    assert policy.self_test().steps > 0 and lads.open(PROJECT / "models/kitchen-small.onnx").notes == ()
    controller = policy.controller()
    for seen in np.random.default_rng(0).uniform(-3, 3, (100, 5)).astype(np.float32):
        with torch.no_grad():
            raw = network(torch.from_numpy((seen - MEAN) / STD).float()[None])[0].numpy()
        assert np.abs(controller.step(seen)[0] - (0.5 * raw + [0.1, -0.1])).max() < 1e-5
    assert list(path.parent.glob("*.lads.onnx")) == [], "nothing is written without an output"
    assert pickle.loads(pickle.dumps(policy)).contract == policy.contract


def test_the_engine_is_the_commands(actor, robot, tmp_path):
    _, path = actor
    policy = lads.import_onnx(str(path), str(robot), output=tmp_path / "ours.onnx")
    command = [sys.executable, "-m", "lads", "import", path, "--contract", robot, "-o", tmp_path / "theirs.onnx"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert (tmp_path / "ours.onnx").read_bytes() == (tmp_path / "theirs.onnx").read_bytes()
    assert said.splitlines()[:-1] == list(policy.notes)
    again = lads.open(tmp_path / "ours.onnx", weights="f16", tolerance=0.05)
    assert again.contract.action == policy.contract.action and policy.path == str(tmp_path / "ours.onnx")


def test_states_are_fed_back(tmp_path):
    torch.manual_seed(1)
    given = torch.zeros(1, 5), torch.zeros(1, 1, 8)
    network = exported(Recurrent(), given, ["obs", "h_in"], ["actions", "h_out"], tmp_path / "gru.onnx")
    (tmp_path / "robot.toml").write_text(HEAD + SEEN.format("state", 5, "") + DONE)
    policy = lads.import_onnx(tmp_path / "gru.onnx", tmp_path / "robot.toml", action="actions", states={"h_in": "h_out"})
    controller = policy.controller()
    for _ in range(2):
        state = torch.zeros(1, 1, 8)
        for seen in np.random.default_rng(0).uniform(-3, 3, (20, 5)).astype(np.float32):
            with torch.no_grad():
                raw, state = network(torch.from_numpy(seen[None]), state)
            assert np.abs(controller.step(seen)[0] - (0.5 * raw[0].numpy() + [0.1, -0.1])).max() < 1e-5
        controller.reset()


def test_files_that_read_each_other(tmp_path):
    torch.manual_seed(2)
    encoder = exported(nn.Linear(5, 3), (torch.zeros(1, 5),), ["seen"], ["latent"], tmp_path / "encoder.onnx")
    actor = exported(nn.Linear(3, 2), (torch.zeros(1, 3),), ["obs"], ["actions"], tmp_path / "actor.onnx")
    (tmp_path / "robot.toml").write_text(HEAD + SEEN.format("state", 5, "") + DONE)
    files = [tmp_path / "encoder.onnx", tmp_path / "actor.onnx"]
    policy = lads.import_onnx(files, tmp_path / "robot.toml", action="actor:actions", wires={"encoder:latent": "actor:obs"})
    seen = np.linspace(-1, 1, 5, dtype=np.float32)
    with torch.no_grad():
        raw = actor(encoder(torch.from_numpy(seen[None])))[0].numpy()
    assert np.abs(policy.controller().step(seen)[0] - (0.5 * raw + [0.1, -0.1])).max() < 1e-5


def test_all_that_is_missing_is_told_at_once(actor, tmp_path):
    _, path = actor
    (tmp_path / "robot.toml").write_text('[action]\nunit = "rad"\nscale = 1\nmin = -1\nmax = 1\n')
    with pytest.raises(lads.errors.ImportOnnxError) as error:
        lads.import_onnx(path, tmp_path / "robot.toml", output=tmp_path / "out.onnx")
    about = [about for about, _ in error.value.problems]
    assert len(about) > 3 and {"control_period_s", "action.offset"} <= set(about), about
    first, *lines = str(error.value).splitlines()
    assert first.startswith(f"{path}: {len(about)} things to settle; ") and "lads.template" in first
    assert [line.strip() for line in lines] == [f"{what}: {wrong}" for what, wrong in error.value.problems]
    assert not (tmp_path / "out.onnx").exists()
    assert pickle.loads(pickle.dumps(error.value)).problems == error.value.problems
    assert isinstance(error.value, lads.errors.OpenError)


def test_the_form_is_the_commands(actor, robot):
    _, path = actor
    form = lads.template(path)
    command = subprocess.run([sys.executable, "-m", "lads", "import", path, "--template"], check=True, capture_output=True, text=True)
    assert form == command.stdout and "# control_period_s" in form and "`obs` [1, 5]" in form
    assert 'elements = ["left", "right"]' in lads.template(path, robot), "what was said stays"


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"policy": "missing.onnx"}, lads.errors.OpenError, "missing.onnx.*No such file"),
        ({"policy": "robot.toml"}, lads.errors.OpenError, "robot.toml.*not an ONNX model"),
        ({"policy": []}, lads.errors.OpenError, "no file was given"),
        ({"robot_toml": "missing.toml"}, lads.errors.ImportOnnxError, "missing.toml: cannot be read"),
        ({"output": "actor.onnx"}, lads.errors.OpenError, "it is what the import reads; name another file"),
        ({"output": "nowhere/out.onnx"}, lads.errors.OpenError, "output nowhere/out.onnx: cannot be written"),
        ({"states": {"h_in": "h_out"}}, lads.errors.ImportOnnxError, "h_in"),
        ({"action": "velocities"}, lads.errors.ImportOnnxError, "velocities"),
        ({"golden": "robot.toml"}, lads.errors.ImportOnnxError, "robot.toml"),
        ({"policy": PROJECT / "models/kitchen-small.onnx"}, lads.errors.ImportOnnxError, "is a policy bundle already"),
        ({"policy": 7}, TypeError, ""),
        ({"states": ["h_in"]}, TypeError, ""),
    ],
)
def test_what_cannot_be_imported_is_named(actor, robot, monkeypatch, arguments, error, text):
    monkeypatch.chdir(robot.parent)
    with pytest.raises(error, match=text):
        lads.import_onnx(**{"policy": "actor.onnx", "robot_toml": "robot.toml", **arguments})
    assert sorted(path.name for path in robot.parent.iterdir()) == ["actor.onnx", "robot.toml"]
