"""Tests that commands of the exporter in the documents parse, and that their inputs that the project brings are there."""

import shlex
from pathlib import Path

import pytest
from lads_exporter import __main__ as command

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
