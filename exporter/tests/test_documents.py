"""Tests that commands of the exporter in the documents and in the Makefile parse, and that their inputs that the project brings are there."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from lads_exporter import __main__ as command, config

ROOT = Path(__file__).parents[2]
FOREIGN = {"target", "vendor", "data", "runs", "out", ".venv"}
MADE_BEFORE = ("runs/", "data/", "results.json", "other.json", "lisa.onnx")  # by a command shown before


def _shown():
    for path in sorted(ROOT.rglob("*.md")):
        if FOREIGN & set(path.relative_to(ROOT).parts):
            continue
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("python -m lads_exporter "):
                yield pytest.param(shlex.split(line, comments=True)[3:], id=line[24:60].strip())


@pytest.mark.parametrize("arguments", list(_shown()))
def test_a_command_that_is_shown_is_one(arguments):
    parsed = vars(command._parser().parse_args(arguments))
    for name in ("config", "data", "run", "model", "results"):
        path = parsed.get(name)
        if path and not path.startswith(MADE_BEFORE):
            assert (ROOT / path).exists(), f"--{name} {path}"


def test_they_are_found():
    assert len(list(_shown())) >= 6


@pytest.mark.parametrize(("typed", "frames", "features"), [
    ("ENV=kitchen", None, None),
    ("ENV=lorel", None, None),
    ("ENV=kitchen-small DATA=data/kitchen.safetensors", None, None),
    ("ENV=lorel-image FRAMES=data/lorel-image.frames", "data/lorel-image.frames", None),
    ("ENV=kitchen-image FEATURES=data/kitchen-image.features", None, "data/kitchen-image.features"),
])  # fmt: skip
def test_make_train_gives_a_setting_what_it_sees(typed, frames, features):
    """Tests the commands of `make collect train export`, which nobody runs in a test because they take hours."""
    if not shutil.which("make"):
        pytest.skip("make is not installed")
    done = subprocess.run(["make", "-n", "train", "export", *typed.split()], cwd=ROOT, capture_output=True, text=True)
    lines = [line.partition(" -m lads_exporter ")[2] for line in done.stdout.splitlines() if " -m lads_exporter " in line]
    train, export = (command._parser().parse_args(shlex.split(line)) for line in lines)
    assert (train.frames, train.features) == (frames, features) and train.out == export.run
    made = config.load(ROOT / train.config).config
    assert (bool(made.images.channel), bool(made.pretrained.encoder)) == (frames is not None, features is not None)
