"""`lads act --images`: frames from folders of PNG files and from stdin do what the same bytes do in lines of numbers; bad ones are refused.

Run with `python -m pytest tests/parity` after `cargo build -p lads-cli`; skipped where the program is missing.
"""

import json
import subprocess

import pytest

np = pytest.importorskip("numpy")
pytest.importorskip("onnxruntime")
Image = pytest.importorskip("PIL.Image")

from lads_exporter import bundle, contract as contracts, kinds, random_policy  # noqa: E402
from programs import newest  # noqa: E402

STEPS = 7


class Policy:
    """A random policy's bundle, and made-up observations."""

    def __init__(self, kind, folder):
        _, model = kinds.export(kind)
        self.path = folder / f"{kind}.onnx"
        bundle.save(model, self.path)
        self.contract = contracts.of(model)
        self.channels = random_policy.channels(self.contract, STEPS, 5)
        known = self.contract.get("instructions")
        self.instruction = ["--instruction", known[0]["id"]] if known else []
        self.cameras = [row["name"] for row in contracts.of_role(self.contract, "observation") if row["dtype"] == "u8"]

    def run(self, *arguments, input=b""):
        command = [newest("lads"), "act", "--model", self.path, *self.instruction, *arguments]
        return subprocess.run([str(part) for part in command], input=input, capture_output=True, timeout=120)

    def lines(self, without=()):
        rows = [np.concatenate([rows[t].ravel() for name, rows in self.channels.items() if name not in without] or [np.zeros(0)]) for t in range(STEPS)]
        return "".join(",".join(map(str, row.tolist())) + "\n" for row in rows).encode()

    def folder(self, name, path):
        path.mkdir()
        for number, frame in enumerate(self.channels[name]):
            Image.fromarray(frame).save(path / f"{number:03}.png")
        return path


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    return {kind: Policy(kind, folder) for kind in ("sighted", "images", "plain")}


def answer(done):
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(done, *parts):
    errors = done.stderr.decode()
    assert done.returncode == 2 and len(errors.splitlines()) == 1, errors
    for part in parts:
        assert part in errors, errors


def test_frames_alone_need_no_lines(policies, tmp_path):
    policy = policies["sighted"]
    wanted = answer(policy.run(input=policy.lines()))
    assert wanted.count(b"\n") == STEPS
    folder = policy.folder("camera", tmp_path / "frames")
    assert answer(policy.run("--images", folder)) == wanted
    assert answer(policy.run("--images", f"camera={folder}")) == wanted
    assert answer(policy.run("--images", "raw", input=policy.channels["camera"].tobytes())) == wanted


def test_frames_beside_lines(policies, tmp_path):
    policy = policies["images"]
    wanted = answer(policy.run(input=policy.lines()))
    assert len(policy.cameras) == 2
    options = []
    for name in policy.cameras:
        options += ["--images", f"{name}={policy.folder(name, tmp_path / name)}"]
    lines = policy.lines(without=policy.cameras)
    assert answer(policy.run(*options, input=lines)) == wanted
    done = policy.run(*options, input=lines + lines[: lines.index(b"\n") + 1])
    assert done.stdout == wanted
    refused(done, f"it has {STEPS} frames")
    refused(policy.run(*options[:2], input=lines), f"`{policy.cameras[1]}` needs one folder")
    (tmp_path / policy.cameras[0] / "000.png").unlink()
    refused(policy.run(*options, input=lines), f"{STEPS - 1} to {STEPS} frames")
    refused(policy.run("--images", tmp_path, input=lines), "several cameras", ", ".join(policy.cameras))
    refused(policy.run("--images", "raw", input=lines), "leave no place for other observations")


def test_a_paced_step_reads_its_frame(policies):
    policy = policies["sighted"]
    bench = [newest("lads"), "bench", "--model", policy.path, "--rate", 80, "--seconds", 1]
    report = lambda *more: subprocess.run([str(part) for part in (*bench, *more)], capture_output=True, text=True, timeout=120)
    text = answer(report())
    assert "80 Hz (a period of 12500.0 us)" in text and "reads a frame (camera 12x16x3)" in text and "not in the times" in text
    measured = json.loads(answer(report("--json")))
    assert measured["period_us"] == 12500 and measured["images"] == ["camera 12x16x3"]
    assert measured["contenders"][0]["latency_us"]["ordinary"]["p50"] > 0


def test_bad_frames_are_refused(policies, tmp_path):
    policy = policies["sighted"]
    policies_without = policies["plain"]
    refused(policies_without.run("--images", tmp_path), "no channel of the policy takes images")
    refused(policy.run("--images", tmp_path / "nowhere"), "nowhere")
    (tmp_path / "empty").mkdir()
    refused(policy.run("--images", tmp_path / "empty"), "no file in it ends in .png")
    frame = policy.channels["camera"][0]
    refused(policy.run("--images", "raw", input=frame.tobytes()[:-1]), "frame 1 has 575 of 576 bytes")
    cases = [
        (lambda path: Image.fromarray(frame[:-1]).save(path), "16 by 11 pixels"),
        (lambda path: Image.fromarray(frame[..., 0]).save(path), "Grayscale"),
        (lambda path: path.write_bytes(b"no picture"), "000.png"),
        (lambda path: path.write_bytes(whole(frame, tmp_path)[:-40]), "000.png"),
    ]
    for number, (spoil, wrong) in enumerate(cases):
        folder = tmp_path / f"bad{number}"
        folder.mkdir()
        spoil(folder / "000.png")
        done = policy.run("--images", folder)
        refused(done, wrong)
        assert done.stdout == b""


def whole(frame, folder):
    Image.fromarray(frame).save(folder / "whole.png")
    return (folder / "whole.png").read_bytes()
