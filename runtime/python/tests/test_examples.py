"""From the export of each framework to a certificate, as the examples show it."""

import importlib.util
import sys

import pytest
import torch

import lads
from conftest import PROJECT

# PyTorch's threads would only wait for each other.
torch.set_num_threads(1)

FOLDER = PROJECT / "runtime/python/examples"


def example(name):
    """Loads the example as a module; skipped if its requirements are not installed."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        pytest.skip(f"{error.name} is not installed")
    return module


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("sb3_pendulum", {"steps": 2000}),
        ("rsl_rl_pendulum", {"iterations": 5}),
        ("isaac_lab", {}),
        ("lerobot_act", {}),
    ],
)
def test_an_export_is_imported_and_equivalent(name, arguments, tmp_path):
    found = example(name).main(tmp_path, **arguments)
    assert found.verdict == "EQUIVALENT", str(found)
    assert found.data["policy"]["compared_steps"] >= 500 and found.data["environment"]["identical_bits"]
    page = (tmp_path / "certificate.html").read_text()
    assert found.data["reference"]["weights_from"] in page and lads.open(tmp_path / "policy.lads.onnx").self_test()


def test_a_normaliser_that_is_forgotten_is_different(tmp_path):
    example_ = example("sb3_pendulum")
    model, environment = example_.train(2000)
    example_.export(model, tmp_path / "policy.onnx")
    said = example_.described(environment).splitlines()
    (tmp_path / "robot.toml").write_text("\n".join(line for line in said if not line.startswith(("offset = [", "scale = ["))))
    policy = lads.import_onnx(tmp_path / "policy.onnx", tmp_path / "robot.toml")
    found = example_.verified(model, environment, policy, episodes=3)
    assert found.verdict == "DIFFERENT" and any("the policy answers otherwise" in reason for reason in found.reasons), str(found)


def test_another_order_of_joints_is_different(tmp_path):
    isaac = example("isaac_lab")
    isaac.main(tmp_path, episodes=1)
    deploy = tmp_path / "params/deploy.yaml"
    deploy.write_text(deploy.read_text().replace("[2, 0, 1]", "[2, 1, 0]"))
    policy = lads.import_onnx(tmp_path / "policy.onnx", tmp_path / "robot.toml")
    found = lads.verify(isaac.Trained(isaac.Exported()), policy.controller(), isaac.Leg, episodes=2)
    assert found.verdict == "DIFFERENT", str(found)
