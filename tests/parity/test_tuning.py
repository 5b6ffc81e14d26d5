"""Export chooses the formats of numbers by the reference beside the bundle, as the shipped bundles were chosen."""

import hashlib
import json
import shutil

import onnx
import pytest
from lads_exporter import contract, reference, tuning
from programs import ROOT, built

MODEL = ROOT / "models" / "kitchen-small.onnx"


@pytest.fixture
def untuned(tmp_path):
    """A copy of the shipped bundle as it was exported -> its path and sha256."""
    model = onnx.load(MODEL)
    sha256 = reference.untuned_sha256(model)
    kept = [row for row in model.metadata_props if row.key != contract.STORAGE_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    path = tmp_path / MODEL.name
    path.write_bytes(model.SerializeToString(deterministic=True))
    assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    return path, sha256


def test_the_reference_beside_a_bundle_tunes_it(untuned):
    path, sha256 = untuned
    shutil.copy(MODEL.with_suffix(".reference.json"), path.parent)
    said = tuning.beside(path, sha256, built("lads-run"))
    assert path.read_bytes() == MODEL.read_bytes(), "as the shipped one was tuned"
    assert "low_level/act" in said


def test_without_its_reference_a_bundle_stays_at_32_bits(untuned):
    path, sha256 = untuned
    before, beside = path.read_bytes(), path.with_suffix(".reference.json")
    assert "need a reference" in tuning.beside(path, sha256, "no-such-program")
    beside.write_text(json.dumps({"bundle_sha256": "0" * 64}))
    assert "of another bundle" in tuning.beside(path, sha256, "no-such-program")
    beside.write_text(json.dumps({"bundle_sha256": sha256}))
    assert "cannot be run" in tuning.beside(path, sha256, path.parent / "no-such-program")
    for damaged in ("{", "[]", "{}"):
        beside.write_text(damaged)
        assert "is not a reference" in tuning.beside(path, sha256, "no-such-program")
    assert path.read_bytes() == before
    # The program is asked, and what it refuses is said.
    beside.write_text(json.dumps({"bundle_sha256": sha256}))
    assert "tune: error: " in tuning.beside(path, sha256, built("lads-run"))
    assert path.read_bytes() == before
