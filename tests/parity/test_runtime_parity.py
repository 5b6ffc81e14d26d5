"""Tests the runtime (`lads act`) against ONNX Runtime on the same bundle: the same plans, actions within 1e-4, over whole episodes.

Run with `python -m pytest tests/parity` in the exporter's environment, after `cargo build -p lads-cli`. Skipped where either is missing.
"""

import base64
import json
import subprocess

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
twin = pytest.importorskip("lads_exporter.twin")
from lads_exporter import contract as contracts  # noqa: E402
from safetensors.numpy import load  # noqa: E402
from programs import ROOT, newest  # noqa: E402

BUNDLES = sorted((ROOT / "models").glob("*.onnx")) + [ROOT / "runtime/compiler/tests/data/tiny.onnx"]
TOLERANCE = 1e-4


def act(bundle, instruction, observations):
    """Runs the runtime on the channels' values [T, ...], in the policy's order -> plans [T], actions [T, A]."""
    rows = [np.concatenate([values[t].reshape(-1).astype(float) for values in observations.values()]) for t in range(steps(observations))]
    lines = "".join(json.dumps(row.tolist()) + "\n" for row in rows)
    command = [newest("lads"), "act", "--model", bundle, "--instruction", instruction, "--plans"]
    done = subprocess.run(command, input=lines, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == steps(observations)
    return np.array([row[-1] for row in rows]), np.array([row[:-1] for row in rows], np.float32)


@pytest.fixture(params=BUNDLES, ids=lambda path: path.stem)
def bundle(request):
    model = onnx.load(request.param)
    golden = load(base64.b64decode(contracts.properties(model)["lads.golden"]))
    return request.param, twin.Twin(model), contracts.of(model), golden


def steps(observations):
    return len(next(iter(observations.values())))


def open_loop(reference, instruction, golden, contract):
    """Runs ONNX Runtime on the golden observations under an instruction -> its rollout, and the observations by channel."""
    names = [channel["name"] for channel in contract["channels"] if channel["role"] == "observation"]
    observations = {name: golden[f"channel.{name}"] for name in names}
    return twin.open_loop(reference, instruction, observations), observations


def test_golden_episode(bundle):
    path, reference, contract, golden = bundle
    index = int(golden["instruction"][0])
    rollout, observations = open_loop(reference, index, golden, contract)
    ours, our_actions = act(path, contract["instructions"][index]["id"], observations)
    assert (ours == rollout.selected).all() and (ours == golden["selected"]).all()
    assert np.abs(our_actions - np.stack(rollout.actions)).max() <= TOLERANCE
    assert np.abs(our_actions - golden["actions"]).max() <= TOLERANCE


@pytest.mark.parametrize("offset", [1, 7])
def test_other_instructions_on_the_same_observations(bundle, offset):
    """Tests other instructions on the same observations, whose meaning does not matter here: any instruction has to give the same numbers.

    Two logits may be closer than rounding; from there on the two may rightly differ, so the comparison ends at the first
    decision with a margin below the tolerance.
    """
    path, reference, contract, golden = bundle
    index = (int(golden["instruction"][0]) + offset) % len(contract["instructions"])
    rollout, observations = open_loop(reference, index, golden, contract)
    close = np.flatnonzero(np.array(rollout.margins) < TOLERANCE)
    period = contracts.period(contract)
    stop = close[0] * period if len(close) else steps(observations)
    assert stop > period, "a comparison of nothing"
    ours, our_actions = act(path, contract["instructions"][index]["id"], observations)
    assert (ours[:stop] == rollout.selected[:stop]).all()
    assert np.abs(our_actions[:stop] - np.stack(rollout.actions)[:stop]).max() <= TOLERANCE
