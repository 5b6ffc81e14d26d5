"""Tests that bundles of contract version 1 become version 2: nothing but the metadata changes, and what says their sha256 follows."""

import base64
import hashlib
import json

import numpy as np
import onnx
import pytest
from safetensors.numpy import load, save
from test_training import run_command

from lads_exporter import bundle, contract as contracts, reference, upgrade
from lads_exporter.config import UserError
from lads_exporter.twin import Twin, open_loop

BEYOND = ("interface", "scale", "offset", "physical_unit")  # what version 1 did not know of an element


def version_1(model):
    """Returns the same bundle as the exporter of version 1 wrote it."""
    old = onnx.ModelProto.FromString(model.SerializeToString())
    found, properties = contracts.of(model), contracts.properties(model)
    element = lambda row: {key: value for key, value in row.items() if key not in BEYOND}
    observation, action = contracts.observation(found), contracts.action(found)
    family = {key: value for key, value in found["family"].items() if key != "kind"}
    contract = {
        "version": 1,
        "kind": "lads",
        **{key: found[key] for key in ("environment", "control_period_s", "context", "language", "network", "provenance")},
        **family,
        "observation": [element(row) for row in observation["elements"]],
        "action": [element(row) for row in action["elements"]],
        "quaternion_order": observation["quaternion_order"],
        "instructions": contracts.splits(found),
    }
    golden = load(base64.b64decode(properties["lads.golden"]))
    names = {"channel.observation": "observations", "selected": "plans"}
    blob = save({names.get(key, key): value for key, value in golden.items()}, metadata={"tolerance": "0.0001"})
    changed = {"lads.contract": json.dumps(contract), "lads.golden": base64.b64encode(blob).decode(), "action_scale": "0.1,0.1,0.02"}
    onnx.helper.set_model_props(old, properties | changed)
    return old


@pytest.fixture
def old(tiny, tmp_path):
    """Writes a bundle of version 1 with a reference, results and a card beside it -> its path."""
    path = tmp_path / "tiny.onnx"
    sha256 = bundle.save(version_1(tiny[3]), path)
    head = f'{{\n "bundle_sha256": "{sha256}",\n "purpose_sha256": "{"0" * 64}",\n "seed": 0\n}}\n'
    (tmp_path / "tiny.reference.json").write_text(head)
    (tmp_path / "tiny.results.json").write_text(json.dumps({"bundle_sha256": sha256}))
    (tmp_path / "tiny.md").write_text(f"- sha256 of the bundle: `{sha256}`\n")
    (tmp_path / "other.results.json").write_text(json.dumps({"bundle_sha256": sha256}))
    return path


def test_the_round_trip_gives_the_bundle_back(tiny, old):
    before = onnx.load(old)
    upgrade.write(old)
    after = onnx.load(old)
    onnx.checker.check_model(after, full_check=True)
    assert before.graph.SerializeToString(deterministic=True) == after.graph.SerializeToString(deterministic=True)
    assert contracts.of(after) == contracts.of(tiny[3])
    assert contracts.properties(after).keys() == contracts.properties(tiny[3]).keys()
    found = load(base64.b64decode(contracts.properties(after)["lads.golden"]))
    for name, rows in load(base64.b64decode(contracts.properties(tiny[3])["lads.golden"])).items():
        assert np.array_equal(found[name], rows), name
    done = open_loop(Twin(after), int(found["instruction"][0]), {"observation": found["channel.observation"]}).tensors()
    assert np.array_equal(done["selected"], found["selected"]) and np.array_equal(done["actions"], found["actions"])


def test_files_beside_it_follow(old):
    before = hashlib.sha256(old.read_bytes()).hexdigest()
    said = upgrade.write(old)
    after = hashlib.sha256(old.read_bytes()).hexdigest()
    assert before != after and after in said
    purpose = reference.purpose_sha256(contracts.of(onnx.load(old)))
    found = json.loads(old.with_suffix(".reference.json").read_text())
    assert found == {"bundle_sha256": after, "purpose_sha256": purpose, "seed": 0}
    assert json.loads(old.with_suffix(".results.json").read_text()) == {"bundle_sha256": after}
    assert old.with_suffix(".md").read_text() == f"- sha256 of the bundle: `{after}`\n"
    assert before in (old.parent / "other.results.json").read_text(), "of another name, so not this bundle's"


def test_another_output_leaves_the_bundle_and_its_files(old, tmp_path):
    kept = {path: path.read_bytes() for path in tmp_path.iterdir()}
    upgrade.write(old, tmp_path / "new.onnx")
    assert all(path.read_bytes() == data for path, data in kept.items())
    contracts.of(onnx.load(tmp_path / "new.onnx"))


def test_the_second_time_nothing_is_done(old, tmp_path):
    upgrade.write(old)
    kept = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()}
    assert "nothing to do" in upgrade.write(old)
    assert kept == {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()}


def test_what_nobody_states_is_said_not_to_be(tiny):
    model = version_1(tiny[3])
    found = upgrade.model(model, None)
    action = contracts.action(found)
    assert action["reference"] == "not stated" and not any("scale" in row for row in action["elements"])


def test_old_contracts_name_the_command(old):
    with pytest.raises(UserError, match=f"python -m lads_exporter upgrade {old}"):
        contracts.of(onnx.load(old), old)


def _strange(old, tmp_path):
    model = onnx.load(old)
    text = tmp_path / "text.onnx"
    text.write_text("no ONNX")
    plain = tmp_path / "plain.onnx"
    onnx.save(onnx.helper.make_model(model.graph), plain)
    properties = contracts.properties(model)
    later, half = tmp_path / "later.onnx", tmp_path / "half.onnx"
    onnx.helper.set_model_props(model, properties | {"lads.contract": json.dumps({"version": 3})})
    onnx.save(model, later)
    onnx.helper.set_model_props(model, properties | {"lads.contract": json.dumps({"version": 1, "kind": "lads"})})
    onnx.save(model, half)
    crooked = tmp_path / "crooked.onnx"
    contract = json.loads(properties["lads.contract"])
    contract["horizon"] = 5
    onnx.helper.set_model_props(model, properties | {"lads.contract": json.dumps(contract)})
    onnx.save(model, crooked)
    return {
        tmp_path / "absent.onnx": "No such file",
        text: "no bundle",
        plain: "no bundle",
        later: "contract version 3",
        half: "not that of version 1",
        crooked: "24, no multiple of the plan period of 5",
    }


def test_other_files_are_refused_with_one_line(old, tmp_path):
    for path, message in _strange(old, tmp_path).items():
        before = path.read_bytes() if path.exists() else None
        out = run_command("upgrade", str(path), folder=tmp_path)
        assert out.returncode == 2, out.stderr
        assert message in out.stderr and str(path) in out.stderr and out.stderr.count("\n") == 1
        assert (path.read_bytes() if path.exists() else None) == before


def test_the_contract_that_a_reference_records_is_upgraded_too():
    text = '{\n "format_version": 2,\n "contract": {"version": 1, "a": "}, \\" b"},\n "seed": 0\n}\n'
    assert upgrade.recorded(text, {"version": 2}) == '{\n "format_version": 2,\n "contract": {"version": 2},\n "seed": 0\n}\n'
    assert upgrade.recorded('{\n "format_version": 1\n}\n', {"version": 2}) == '{\n "format_version": 1\n}\n'
