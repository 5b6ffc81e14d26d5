"""Frames of the harness against MuJoCo's own renderer in Python, on stored states of the LOReL table.

With whole meshes the same libraries draw the same triangles: the mean absolute difference (MAD, of 8-bit channels) is below 0.1, which leaves
room for two versions of Mesa. What ships draws the arm with fewer faces: its MAD to whole meshes is below 2 (measured 1.0), and to the scene's
full quality (shadows of 4096, reflections) below 2.5 (measured 1.2).

Run with `python -m pytest tests/parity` after `cargo build -p lads-sim --features record`; skipped where mujoco, EGL or the programs are missing.
"""

import json
import pathlib
import subprocess
import sys

import pytest

np = pytest.importorskip("numpy")
pytest.importorskip("mujoco")
from safetensors.numpy import load_file  # noqa: E402
from programs import ROOT, newest  # noqa: E402

SCENE = ROOT / "sim-harness/src/environments/lorel/scene.xml"
RENDERER = pathlib.Path(__file__).with_name("reference_renderer.py")
NO_EGL = 3  # how it ends where there is none
SHIPS = {
    "view": {"camera": "cam0"},
    "size": [64, 64],
    "drawn": [64, 64],
    "samples": 4,
    "shadow_size": 512,
    "shadow_clip": 0.3,
    "reflections": False,
    "hidden": ["base", "head"],
    "mesh_cell_m": 0.012,
}
EVERY = 9  # of the states


def run(name, *arguments):
    done = subprocess.run([newest(name), *map(str, arguments)], capture_output=True, text=True, timeout=300)
    if "built without cameras" in done.stderr or "pictures need OpenGL" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "lorel.safetensors"
    run("lads-collect", "--env", "lorel", "--episodes", 5, "--seed", 1, "-o", path)
    return path


def ours(data, rendering=None):
    """-> every EVERYth frame of the dataset."""
    out = data.with_name(f"{len(list(data.parent.iterdir()))}.frames")
    more = []
    if rendering:
        more = ["--rendering", out.with_suffix(".json")]
        more[1].write_text(json.dumps(rendering))
    run("lads-run", "frames", data, "-o", out, *more)
    return load_file(out)["frames"][::EVERY].astype(int)


def reference(data, rendering=None):
    """The same by `mujoco.Renderer`; the scene's own quality without a rendering."""
    out = data.with_name(f"{len(list(data.parent.iterdir()))}.npy")
    more = []
    if rendering:
        more = [out.with_suffix(".json")]
        more[0].write_text(json.dumps(rendering))
    command = [sys.executable, RENDERER, data, out, EVERY, *more]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)
    if done.returncode == NO_EGL:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    return np.load(out).astype(int)


def test_frames_are_those_of_the_reference_renderer(data):
    whole = SHIPS | {"mesh_cell_m": 0.0}
    theirs = reference(data, whole)
    mad = lambda a, b: float(np.abs(a - b).mean())
    assert mad(ours(data, whole), theirs) < 0.1
    shipped = ours(data)
    assert np.array_equal(shipped, ours(data, SHIPS)), "the rendering that ships is another"
    full = reference(data)
    print("MAD to whole meshes, to full quality:", mad(shipped, theirs), mad(shipped, full))
    assert mad(shipped, theirs) < 2.0
    assert mad(shipped, full) < 2.5
    # A frame says where things are: another state's frame is further away than any of these.
    assert mad(shipped[:-1], shipped[1:]) > 3 * mad(shipped, full)


def test_what_is_wrong_is_said_in_one_line(data, tmp_path):
    for text, wrong in (("{}", "missing field"), (json.dumps(SHIPS | {"size": [65, 64]}), "smaller"), (json.dumps(SHIPS | {"fog": 1}), "fog")):
        rendering = tmp_path / "rendering.json"
        rendering.write_text(text)
        command = [newest("lads-run"), "frames", data, "-o", tmp_path / "x.frames", "--rendering", rendering]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and wrong in done.stderr, done.stderr
    done = subprocess.run([newest("lads-run"), "frames", SCENE, "-o", tmp_path / "x.frames"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "no safetensors file" in done.stderr
