"""Policies that see by a camera and observe the first elements of the state beside it, end to end: reference and verification of random policies on the
LOReL table, whose frozen encoder is a small random one.

PyTorch acts over the whole history on frames of `lads-run frames --stream` and joints of the official environment; the harness draws the states again and
gives the compiled policy both. Run and skipped as `test_sight` is.
"""

import base64
import copy
import dataclasses
import json

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
torch = pytest.importorskip("torch")
pytest.importorskip("mujoco")
from safetensors.numpy import load  # noqa: E402
from lads_exporter import bundle, config, contract as contracts, encoders, language, random_policy, reference, systems  # noqa: E402
from programs import ROOT, newest  # noqa: E402
from test_rendering import SHIPS  # noqa: E402
from test_sight import DIFFERENT, INCONCLUSIVE, run, verify  # noqa: E402

JOINTS, HORIZON, WINDOW = 3, 5, 4
SEEN = {"channel": "camera", "encoder": "random-4", "joints": JOINTS, "std_floor": 0.1, "clip": 10.0}
SYSTEMS = {
    "lads": {"kind": "lads", "regressed": False},
    "wo_cp": {"kind": "lads", "regressed": True},
    "vae": {"kind": "vae", "beta": 5e-4, "rule": "sample"},
    "lang_dt": {"kind": "lang_dt"},
    "lisa_history": {"kind": "lisa", "low_level_layers": 2, "option_gradient": "first"},
    "lisa": {"kind": "lisa", "low_level_layers": 2, "option_gradient": "first"},
}


def setting_of(system):
    """Makes a system's setting on the LOReL table, from the kitchen's from images."""
    table, *_ = config.load(ROOT / "exporter/configs/kitchen-image.toml").tables
    _, environment, instructions = config.load(ROOT / "exporter/configs/lorel.toml").tables
    table["system"] = SYSTEMS[system]
    table["language"] |= {"encoder": "random-8", "pool": False}
    table["high_level"] |= {"hidden": 32, "heads": 2, "layers": 2, "context_steps": 20}
    table["low_level"] |= {"hidden": 32, "layers": 2}
    table["history"] |= {"window": 0 if system in ("lang_dt", "lisa") else WINDOW, "heads": 2}
    table["encoder"] |= {"observed": JOINTS, "horizon": HORIZON, "codebook_size": 6, "codebook_dim": 5}
    table["pretrained"] = SEEN | {"features": encoders.network(SEEN["encoder"], SEEN["channel"], SHIPS["size"]).features()}
    table["data"] |= {"weights": {}, "ending_rate": 0.0}
    few = {split: instructions[split][:1] for split in ("atomic", "composite")}
    return dataclasses.replace(config.from_tables(table, environment, few, "test"), rendering=SHIPS)


def networks_of(setting, encoded):
    """Makes a system's networks with random weights, and the frozen encoder's."""
    torch.manual_seed(3)
    generator = torch.Generator().manual_seed(3)
    networks = systems.of(setting.config).Networks(setting, encoded).eval()
    random_policy.draw_weights(networks, generator)
    if hasattr(networks, "codebook"):
        networks.codebook.codes.copy_(torch.randn(networks.codebook.codes.shape, generator=generator))
    networks.frames.network.load_state_dict(encoders.load(SEEN["encoder"], SEEN["channel"], SHIPS["size"])[0].state_dict())
    # The joints as they lie in their limits, the features as the encoder gives them.
    random_policy.place_normalizer(networks.frames.normalizer, setting.environment["observation"][:JOINTS] + [{"min": 0.0, "max": 3.0}] * setting.config.pretrained.features)
    return networks


def write(system, folder):
    """Writes a random policy's bundle and its run -> the bundle's path, the model."""
    setting = setting_of(system)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    networks = networks_of(setting, encoded)
    folder.mkdir()
    identity = {"tables": setting.tables, "dataset_sha256": "none", "rendering": SHIPS}
    torch.save({"identity": identity, "networks": networks.state_dict(), "position": {"stage": 9}}, folder / "checkpoint.pt")

    def seen(seed):
        frames = np.random.default_rng(seed).integers(0, 256, (2 * HORIZON + 2, *SHIPS["size"], 3), np.uint8)
        return {"camera": frames, "observation": random_policy.observations(setting, len(frames), seed)[:, :JOINTS]}

    golden = ((0, seen(seed)) for seed in range(200))
    model = bundle.assemble(networks, setting, encoded, {"dataset_sha256": "none", "seed": 3, "steps": {}}, golden)
    bundle.save(model, folder / "policy.onnx")
    return folder / "policy.onnx", model


@pytest.fixture(scope="module", params=SYSTEMS)
def made(request, tmp_path_factory):
    """-> the bundle's path, the model, its reference's path."""
    folder = tmp_path_factory.mktemp("sight-and-joints")
    (folder / "rendering.json").write_text(json.dumps(SHIPS))
    probe = run("frames", "--stream", "lorel-table", "--rendering", folder / "rendering.json")  # skips without EGL
    assert probe.returncode == 0, probe.stderr
    path, model = write(request.param, folder / "run")
    file = folder / "r.json"
    reference.write(path, file, run=folder / "run", episodes=2, traced=1, noise="none", lads_run=newest("lads-run"))
    return path, model, file


def test_the_bundle_is_its_reference(made, tmp_path):
    path, model, file = made
    code, found = verify(path, file, tmp_path)
    seen, asked = found["frames"], found["policy"]
    assert asked["differing_episodes"] == 0 and asked["steps"] == seen["steps"] > 30, found["reasons"]
    assert asked["largest_action_difference"] < 1e-4
    assert asked["compared_decisions"] == (-(-seen["steps"] // HORIZON) if "codebook" in contracts.of(model)["family"] else 0)
    assert found["environment"]["first_difference"] is None and seen["differing"] == 0
    rollouts = found["rollouts"]
    assert rollouts["identical_plans"] == 1 and rollouts["agreeing_steps"][0] > 0
    # Few episodes cannot show equivalence of rates, which is all that is left to say.
    assert code == INCONCLUSIVE and all("interval" in reason for reason in found["reasons"]), found["reasons"]


def test_other_joints_are_another_question(made, tmp_path):
    path, _, file = made
    told = json.loads(file.read_text())
    trace = told["instructions"][0]["episodes"][0]["trace"]
    joints = np.frombuffer(base64.b64decode(trace["observations"]), "<f4").reshape(-1, JOINTS).copy()
    assert np.ptp(joints, axis=0).max() > 0.01
    joints[7] += 0.1
    trace["observations"] = base64.b64encode(joints.tobytes()).decode()
    other = tmp_path / "other.json"
    other.write_text(json.dumps(told))
    code, found = verify(path, other, tmp_path)
    assert code == DIFFERENT and found["policy"]["first_difference"]["step"] == 7 and found["frames"]["differing"] == 0


@pytest.mark.parametrize(("damage", "wrong"), [
    (lambda trace: trace.update(observations=""), "its traces hold no observations, and the policy observes a vector"),
    (lambda trace: trace.pop("observations"), "missing field `observations`"),
    (lambda trace: trace.update(observations=trace["observations"][:-16]), "not one of the policy's for each step"),
    (lambda trace: trace.update(observations="?"), "Invalid"),
    (lambda trace: trace.update(observations=base64.b64encode(np.full(len(base64.b64decode(trace["observations"])) // 4, np.nan, "<f4").tobytes()).decode()), "not finite"),
])  # fmt: skip
def test_damaged_joints_are_refused_in_one_line(made, tmp_path, damage, wrong):
    path, _, file = made
    told = json.loads(file.read_text())
    damage(told["instructions"][1]["episodes"][0]["trace"])
    other = tmp_path / "other.json"
    other.write_text(json.dumps(told))
    done = run("verify", "--model", path, "--reference", other)
    assert done.returncode == 2 and wrong in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr


def test_a_damaged_weight_is_different(made, tmp_path):
    path, model, file = made
    damaged = copy.deepcopy(model)
    *_, weight = (row for row in damaged.graph.initializer if row.name.endswith("level.embed_observation.weight"))
    values = onnx.numpy_helper.to_array(weight).copy()  # [n, k]
    values[:, :JOINTS] *= 1.05  # all of it would only scale what a norm takes out again
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    # The golden episode is recorded anew, as an exporter with that fault would.
    golden = load(base64.b64decode(contracts.properties(model)["lads.golden"]))
    seen = {name: golden[f"channel.{name}"] for name in ("camera", "observation")}
    again = bundle.golden(damaged, [(int(golden["instruction"][0]), seen)])
    for row in damaged.metadata_props:
        if row.key == "lads.golden":
            row.value = base64.b64encode(again).decode()
    bundle.save(damaged, tmp_path / "damaged.onnx")
    code, found = verify(tmp_path / "damaged.onnx", file, tmp_path)
    assert code == DIFFERENT and found["policy"]["differing_episodes"] > 0 and found["frames"]["differing"] == 0
