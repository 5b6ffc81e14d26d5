"""Tests that `lads-run verify` calls a damaged policy DIFFERENT.

Each damage is done to the shipped bundle's ONNX file, and the golden episode is recorded anew with the damaged graph, as an exporter with
that fault would: the self-test passes, and only the comparison with the reference can see it.

Run with `python -m pytest tests/parity` in the exporter's environment, after `cargo build -p lads-sim`. Skipped where either is missing.
"""

import base64
import json
import subprocess

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
exporter = pytest.importorskip("lads_exporter.bundle")
from onnx import helper, numpy_helper  # noqa: E402
from safetensors.numpy import load, save  # noqa: E402
from programs import ROOT, newest  # noqa: E402

BUNDLE, REFERENCE = ROOT / "models/kitchen.onnx", ROOT / "models/kitchen.reference.json"
EQUIVALENT, DIFFERENT, INCONCLUSIVE = 0, 1, 3
JOINT = 3


def verify(bundle, folder):
    """Runs `lads-run verify` -> exit code, certificate."""
    file = folder / "certificate.json"
    command = [newest("lads-run"), "verify", "--model", bundle, "--reference", REFERENCE, "--certificate", file, "--instruction", "kbls", "--episodes", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode in (EQUIVALENT, DIFFERENT, INCONCLUSIVE), done.stderr
    return done.returncode, json.loads(file.read_text())


def properties(model):
    return {entry.key: entry.value for entry in model.metadata_props}


def edit(model, name, change):
    """Replaces an initializer by `change` of it."""
    tensor = next(row for row in model.graph.initializer if row.name.removeprefix("weights/") == name)
    changed = change(numpy_helper.to_array(tensor).copy())
    tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(changed), tensor.name))


# The two layers that read an observation, [outputs, inputs]; the normaliser's scale is folded into their columns.
READERS = ("high_level.embed_observation.weight", "low_level.layer.0.weight")


def scale_off(model):
    """Damages the normaliser: it takes one joint's standard deviation for 2 % smaller than it is."""

    def change(weight):
        weight[:, JOINT] *= 1.02
        return weight

    for name in READERS:
        edit(model, name, change)


def joints_swapped(model):
    """Damages the observation: two joints arrive in each other's place."""

    def change(rows):
        order = list(range(rows.shape[-1]))
        order[JOINT], order[JOINT + 1] = order[JOINT + 1], order[JOINT]
        return rows[..., order]

    for name in (*READERS, "observation_mean"):
        edit(model, name, change)


def horizon_off(model):
    """Damages the horizon: plans are decided every H + 1 steps; the trajectory encoder drops the last step of its longer window."""
    contract = json.loads(properties(model)["lads.contract"])
    horizon, graph = contract["family"]["horizon"], model.graph
    contract["family"]["horizon"] += 1
    # A context ends with a plan.
    contract["context"]["steps"] -= contract["context"]["steps"] % (horizon + 1)
    for channel in contract["channels"]:
        if channel["role"] == "demonstration":
            channel["shape"][0] += 1
    set_property(model, "lads.contract", json.dumps(contract))
    bounds = {"damage/from": [0], "damage/to": [horizon], "damage/axis": [1]}
    graph.initializer.extend(numpy_helper.from_array(np.array(value, np.int64), name) for name, value in bounds.items())
    for part in ("observations", "actions"):
        name, window = f"trajectory_encoder/encode/{part}", f"trajectory_encoder/encode/damage/{part}"
        for node in graph.node:
            node.input[:] = [window if given == name else given for given in node.input]
        value = next(row for row in graph.input if row.name == name)
        assert value.type.tensor_type.shape.dim[1].dim_value == horizon
        value.type.tensor_type.shape.dim[1].dim_value += 1
        graph.node.insert(0, helper.make_node("Slice", [name, *bounds], [window], name=window))


def second_best(model):
    """Damages the choice: the likeliest plan is never taken, as its logit is pushed below the others."""
    graph = model.graph
    graph.initializer.extend(
        [
            numpy_helper.from_array(np.array(1e-6, np.float32), "damage/epsilon"),
            numpy_helper.from_array(np.array(1e9, np.float32), "damage/far"),
            numpy_helper.from_array(np.array([-1], np.int64), "damage/axes"),
        ]
    )
    for entry in ("high_level/start", "high_level/step"):
        output, local = f"{entry}/logits", lambda name: f"{entry}/damage/{name}"
        producer = next(node for node in graph.node if output in node.output)
        producer.output[list(producer.output).index(output)] = local("logits")
        steps = [
            ("ReduceMax", [local("logits"), "damage/axes"], local("best")),
            ("Sub", [local("logits"), local("best")], local("behind")),
            ("Add", [local("behind"), "damage/epsilon"], local("ahead")),
            ("Relu", [local("ahead")], local("is_best")),
            ("Mul", [local("is_best"), "damage/far"], local("push")),
            ("Sub", [local("logits"), local("push")], output),
        ]
        graph.node.extend(helper.make_node(kind, inputs, [out], name=out) for kind, inputs, out in steps)


def set_property(model, key, value):
    next(row for row in model.metadata_props if row.key == key).value = value


def record_golden(model):
    """Records the golden episode as an exporter with this fault would have recorded it."""
    golden = load(base64.b64decode(properties(model)["lads.golden"]))
    runner = exporter.twin.Twin(model)
    index, channels = int(golden["instruction"][0]), {"observation": golden["channel.observation"][: runner.steps]}
    rollout = exporter.twin.open_loop(runner, index, channels)
    tensors = exporter.golden_tensors(rollout, index, channels)
    set_property(model, "lads.golden", base64.b64encode(save(tensors, metadata={"tolerance": "0.0001"})).decode())


@pytest.mark.parametrize("damage", [scale_off, joints_swapped, horizon_off, second_best], ids=lambda damage: damage.__name__)
def test_a_damaged_policy_is_different(damage, tmp_path):
    model = onnx.load(BUNDLE)
    damage(model)
    # The formats were chosen for the policy that is whole.
    model.metadata_props.remove(next(row for row in model.metadata_props if row.key == "lads.storage"))
    record_golden(model)
    path = tmp_path / "damaged.onnx"
    path.write_bytes(model.SerializeToString())
    code, certificate = verify(path, tmp_path)
    assert code == DIFFERENT and certificate["verdict"] == "DIFFERENT"
    assert certificate["policy"]["differing_episodes"] == 1
    assert certificate["environment"]["first_difference"] is None
    assert any("the policy answers otherwise" in reason for reason in certificate["reasons"])
    assert not certificate["reference"]["same_bundle"]


def test_another_rule_is_different_though_the_networks_are_the_same(tmp_path):
    """Tests a policy that samples at temperature 5, and hardly ever succeeds: the contract is compared, and its own rule is what is run."""
    model = onnx.load(BUNDLE)
    contract = json.loads(properties(model)["lads.contract"])
    contract["family"]["decision"] |= {"rule": "sample", "temperature": 5.0}
    set_property(model, "lads.contract", json.dumps(contract))
    path = tmp_path / "sampled.onnx"
    path.write_bytes(model.SerializeToString())
    code, certificate = verify(path, tmp_path)
    assert code == DIFFERENT and certificate["setting"]["decision"] == "sampling at temperature 5"
    assert "family.decision.rule" in certificate["reasons"][0]
    assert [row["field"] for row in certificate["contract"]["differing"]] == ["family.decision.rule", "family.decision.temperature"]


def test_the_shipped_policy_is_not(tmp_path):
    code, certificate = verify(BUNDLE, tmp_path)
    # One episode cannot show equivalence of rates, but there is no difference.
    assert code == INCONCLUSIVE
    assert certificate["policy"]["differing_episodes"] == 0
    assert certificate["policy"]["largest_action_difference"] < 1e-4
    assert certificate["rollouts"]["identical_completions"] == 1.0
    assert certificate["reference"]["same_bundle"]
