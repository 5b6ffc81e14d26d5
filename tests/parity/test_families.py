"""Tests every family of policies through the runtime, beside ONNX Runtime: random bundles and episodes, made here by the exporter's own
twin of the schedule, and the ignored tests of `lads-tests` on them (`families`, and the instruction counts where valgrind is installed).

Skipped where the exporter's environment or cargo is missing.
"""

import dataclasses
import os
import re
import shutil
import subprocess

import pytest
from programs import ROOT, SELECTION, newest

pytest.importorskip("onnxruntime")
pytest.importorskip("lads_exporter.episode")
from families import fill  # noqa: E402
from lads_exporter import bundle, kinds  # noqa: E402


@pytest.fixture(scope="module")
def families(tmp_path_factory):
    """Makes the folder with a bundle and an episode of each kind."""
    folder = tmp_path_factory.mktemp("families")
    fill(folder)
    return folder


def ignored(target, folder, *names):
    """Runs the ignored tests of a target -> what they printed, and how many passed."""
    if not shutil.which("cargo"):
        pytest.skip("cargo is not installed")
    command = ["cargo", "test", *SELECTION, "--test", target, "--", "--ignored", "--nocapture", *names]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"LADS_FAMILIES": str(folder)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout, sum(map(int, re.findall(r"test result: ok\. (\d+) passed", done.stdout)))


def test_every_family_replays(families):
    _, passed = ignored("families", families)
    assert passed == 4 * len(kinds.KINDS) + 1, "beside ONNX Runtime, bits, allocations, damaged images; every kind has its tests"


def test_edited_images_and_bundles(families):
    """Runs the fuzz targets' functions on edit scripts of a seeded generator: images of every family, and the bundle of a policy that sees
    images."""
    if not shutil.which("cargo"):
        pytest.skip("cargo is not installed")
    command = ["cargo", "test", *SELECTION, "--test", "hostile", "--", "--nocapture", "edited"]
    more = {"LADS_FAMILIES": str(families), "LADS_FUZZ_SECONDS": "30"}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | more, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    scripts = dict(re.findall(r"(image|bundle): (\d+) generated scripts", done.stdout))
    assert min(map(int, scripts.values())) > 100 and len(scripts) == 2


@pytest.mark.parametrize("kind", ["lads", "lisa", "vae", "history", "vae_history", "frozen_lisa"])
def test_plans_of_one_step(kind, tmp_path, monkeypatch):
    """Tests that a policy that decides at every step replays: entries for later steps under a plan never run."""
    known = kinds.KINDS[kind]
    monkeypatch.setitem(kinds.KINDS, kind, dataclasses.replace(known, sizes=dataclasses.replace(known.sizes, horizon=1)))
    _, model = kinds.export(kind, seed=0)
    bundle.save(model, tmp_path / "one.onnx")
    done = subprocess.run([newest("lads"), "self-test", tmp_path / "one.onnx"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_instruction_counts(families):
    printed, passed = ignored("instruction_counts", families)
    assert passed == 1
    if "skipped: valgrind" in printed:
        pytest.skip("valgrind is not installed")
    assert re.findall(r"instructions of (\w+)'s steps", printed) == sorted(kinds.KINDS)
