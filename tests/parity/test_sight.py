"""Policies with a camera, end to end: reference, verification, log, replay and report of a random policy on the LOReL table.

PyTorch drives the official environment on frames of `lads-run frames --stream`; the harness draws the same states again and asks the compiled
policy. Run with `python -m pytest tests/parity` after `cargo build -p lads-sim --features record,report`; skipped where mujoco, EGL or the
programs are missing.
"""

import base64
import copy
import dataclasses
import json
import os
import subprocess

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
pytest.importorskip("mujoco")
from safetensors.numpy import load  # noqa: E402
from lads_exporter import bundle, config, contract as contracts, frames, language, random_policy, reference  # noqa: E402
from programs import ROOT, newest  # noqa: E402
from test_rendering import SHIPS  # noqa: E402

EQUIVALENT, DIFFERENT, INCONCLUSIVE = 0, 1, 3
SMALL = """
[language]
encoder = "random-12"
[high_level]
hidden = 32
heads = 2
[low_level]
hidden = 32
layers = 2
[encoder]
codebook_size = 6
codebook_dim = 5
[images]
widths = [4, 8, 8, 16]
hidden = [32]
features = 16
"""
NO_EGL = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}


def run(*arguments, **environment):
    command = [str(part) for part in (newest("lads-run"), *arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=os.environ | environment)
    if not environment and ("built without cameras" in done.stderr or "pictures need OpenGL" in done.stderr):
        pytest.skip(done.stderr)
    return done


def random_bundle(path):
    small = path.with_suffix(".toml")
    small.write_text(SMALL)
    setting = config.load(ROOT / "exporter/configs/lorel-image.toml", small)
    few = [row for row in setting.instructions if row["split"] in ("seen", "atomic")] or setting.instructions
    setting = dataclasses.replace(setting, instructions=few[:3], rendering=SHIPS)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    _, model = random_policy.export(setting, encoded, 0)
    bundle.save(model, path)
    return model


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """-> folder with sighted.onnx and its reference, the model."""
    folder = tmp_path_factory.mktemp("sight")
    model = random_bundle(folder / "sighted.onnx")
    with (folder / "rendering.json").open("w") as file:
        json.dump(SHIPS, file)
    probe = run("frames", "--stream", "lorel-table", "--rendering", folder / "rendering.json")  # skips without EGL
    assert probe.returncode == 0, probe.stderr
    reference.write(folder / "sighted.onnx", folder / "sighted.reference.json", episodes=2, traced=1, noise="none", lads_run=newest("lads-run"))
    return folder, model


def verify(model, written, folder, *more):
    """-> exit code, certificate."""
    file = folder / "certificate.json"
    page = folder / "certificate.html"
    done = run("verify", "--model", model, "--reference", written, "--certificate", file, "--certificate", page, *more)
    assert done.returncode in (EQUIVALENT, DIFFERENT, INCONCLUSIVE), done.stderr
    assert "What the cameras show" in page.read_text()
    return done.returncode, json.loads(file.read_text())


def test_frames_and_answers_are_the_reference_s(made, tmp_path):
    folder, _ = made
    code, found = verify(folder / "sighted.onnx", folder / "sighted.reference.json", tmp_path)
    seen = found["frames"]
    assert seen["steps"] > 30 and seen["differing"] == seen["left_out"] == 0 and seen["first_difference"] is None
    assert set(seen["reference_renderer"]) == {"lads-sim", "mujoco"}
    asked = found["policy"]
    assert asked["differing_episodes"] == 0 and asked["steps"] == seen["steps"] and asked["compared_decisions"] >= 3
    assert asked["largest_action_difference"] < 1e-4 and asked["largest_logit_difference"] < 1e-3
    assert found["environment"]["first_difference"] is None
    assert found["rollouts"]["identical_plans"] == 1 and found["rollouts"]["agreeing_steps"][0] > 0
    # Six episodes are too few, which is all that is left to say.
    assert (code, found["verdict"]) == (INCONCLUSIVE, "INCONCLUSIVE")
    assert all("interval" in reason for reason in found["reasons"]), found["reasons"]


def test_another_frame_leaves_its_questions_out_and_decides_nothing(made, tmp_path):
    folder, _ = made
    file = json.loads((folder / "sighted.reference.json").read_text())
    trace = file["instructions"][1]["episodes"][0]["trace"]
    digests = bytearray(base64.b64decode(trace["frames"]))
    steps = len(digests) // frames.DIGEST
    digests[3 * frames.DIGEST] ^= 1
    trace["frames"] = base64.b64encode(digests).decode()
    other = tmp_path / "other.json"
    other.write_text(json.dumps(file))
    code, found = verify(folder / "sighted.onnx", other, tmp_path)
    seen = found["frames"]
    assert (seen["differing"], seen["left_out"], seen["differing_episodes"]) == (1, steps - 3, 1)
    assert seen["first_difference"]["step"] == 3
    assert found["policy"]["differing_episodes"] == 0 and found["policy"]["steps"] == seen["steps"] - seen["left_out"]
    assert code == INCONCLUSIVE and any("draws 1 of" in reason for reason in found["reasons"])
    # Without its frames it is refused.
    for row in (episode for instruction in file["instructions"] for episode in instruction["episodes"] if "trace" in episode):
        del row["trace"]["frames"]
    other.write_text(json.dumps(file))
    done = run("verify", "--model", folder / "sighted.onnx", "--reference", other)
    assert done.returncode == 2 and "hold no frames" in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_damaged_encoder_is_different(made, tmp_path):
    folder, model = made
    damaged = copy.deepcopy(model)
    weight = next(row for row in damaged.graph.initializer if row.name.removeprefix("weights/") == "camera.0.weight")
    weight.CopyFrom(onnx.numpy_helper.from_array(1.05 * onnx.numpy_helper.to_array(weight), weight.name))
    # The golden episode is recorded anew, as an exporter with that fault would.
    golden = load(base64.b64decode(contracts.properties(model)["lads.golden"]))
    again = bundle.golden(damaged, [(int(golden["instruction"][0]), {"camera": golden["channel.camera"]})])
    for row in damaged.metadata_props:
        if row.key == "lads.golden":
            row.value = base64.b64encode(again).decode()
    bundle.save(damaged, tmp_path / "damaged.onnx")
    code, found = verify(tmp_path / "damaged.onnx", folder / "sighted.reference.json", tmp_path)
    assert code == DIFFERENT and found["policy"]["differing_episodes"] > 0 and found["frames"]["differing"] == 0


def test_a_log_holds_what_was_seen_and_replays(made, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    image = pytest.importorskip("PIL.Image")
    folder, model = made
    log, page = tmp_path / "flight.mcap", tmp_path / "report.html"
    first = contracts.of(model)["instructions"][0]["id"]
    done = run("--model", folder / "sighted.onnx", "--episodes", 1, "--instruction", first, "--log", log, "--report", page)
    assert done.returncode == 0, done.stderr
    with log.open("rb") as file:
        messages = list(reader.make_reader(file).iter_messages(topics=["/images/camera"]))
    schema, channel, _ = messages[0]
    assert (schema.name, schema.encoding, channel.message_encoding) == ("foxglove.CompressedImage", "jsonschema", "json")
    # The seed is the reference's, so the first episode is its first: every frame has the digest that was recorded.
    trace = json.loads((folder / "sighted.reference.json").read_text())["instructions"][0]["episodes"][0]["trace"]
    known = np.frombuffer(base64.b64decode(trace["frames"]), np.uint8).reshape(-1, frames.DIGEST)
    assert len(messages) == len(known)
    for (_, _, message), digest in zip(messages, known):
        data = json.loads(message.data)
        assert data["format"] == "png" and data["frame_id"] == "camera"
        path = tmp_path / "frame.png"
        path.write_bytes(base64.b64decode(data["data"]))
        assert np.array_equal(frames.digest(np.asarray(image.open(path))), digest)
    replayed = run("replay", log, "--model", folder / "sighted.onnx")
    assert replayed.returncode == 0 and "EQUAL: 1 episodes" in replayed.stdout, replayed.stderr + replayed.stdout
    html = page.read_text()
    assert "<h2>What the policy saw</h2>" in html
    seen = html.count("data:image/png;base64,")
    assert seen == -(-len(known) // 10), "a frame for each decision"
    assert len(html) < 2_000_000


def test_a_machine_without_egl_says_so_in_one_line(made, tmp_path):
    folder, _ = made
    model = ("--model", folder / "sighted.onnx")
    log = tmp_path / "x.mcap"
    jobs = (
        (*model, "--episodes", 1, "--log", log),
        ("verify", *model),
        ("frames", "--stream", "lorel-table"),
    )
    for job in jobs:
        done = run(*job, **NO_EGL)
        assert done.returncode == 2 and done.stdout == "" and not log.exists(), done.stdout
        assert len(done.stderr.splitlines()) == 1 and "EGL" in done.stderr, done.stderr


def test_a_stream_refuses_half_a_state():
    done = subprocess.run([newest("lads-run"), "frames", "--stream", "lorel-table"], input=bytes(15 * 8 + 3), capture_output=True, timeout=300)
    if b"pictures need OpenGL" in done.stderr or b"built without" in done.stderr:
        pytest.skip(done.stderr.decode())
    assert done.returncode == 2 and b"within a state: 3 of its 120 bytes" in done.stderr
    head, _, rest = done.stdout.partition(b"\n")
    assert json.loads(head)["positions"] == 15 and len(rest) == 64 * 64 * 3
    for arguments, wrong in ((["--stream", "ant-maze"], b"no environment is called"), (["--stream", "lorel-table", "-o", "x"], b"cannot be used with")):
        done = subprocess.run([newest("lads-run"), "frames", *arguments], input=b"", capture_output=True, timeout=300)
        assert done.returncode == 2 and wrong in done.stderr, done.stderr
