"""Finds and builds the programs that the parity tests run beside Python."""

import os
import pathlib
import re
import shutil
import subprocess

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
TARGET = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
# Packages and features of the whole suite: cargo builds nothing twice for another selection.
FEATURES = re.search(r"^CARGO_FEATURES := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
SELECTION = ("--workspace", "--features", FEATURES)
# With an example, cargo counts in the dependencies of tests, whose features are those of their build.
AS_TESTS = ("--example", "controller")


def newest(name):
    """Finds the newest build of a program, released or for tests -> its path; skips the test where there is none."""
    builds = [path for path in (TARGET / profile / name for profile in ("release", "debug")) if path.is_file()]
    if not builds:
        pytest.skip(f"{name} is not built: run `make test-exporter`")
    return max(builds, key=lambda path: path.stat().st_mtime)


def built(name):
    """Builds a program as the suite does -> its path; skips the test where cargo is missing."""
    if not shutil.which("cargo"):
        pytest.skip("cargo is not installed")
    subprocess.run(["cargo", "build", "--quiet", *SELECTION, "--bin", name, *AS_TESTS], cwd=ROOT, check=True)
    return TARGET / "debug" / name
