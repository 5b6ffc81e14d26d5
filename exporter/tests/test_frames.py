"""Frames: their file, augmentation, and LADS on them, from a few steps of each stage to a bundle that acts as its networks do."""

import copy
import dataclasses
import json
import math
import struct

import numpy as np
import pytest
import synthetic
import torch
from resuming import assert_same_weights, interrupt
from test_training import setting_for

from lads_exporter import bundle, config, contract as contracts, dataset, frames, language, systems, training, twin, whole
from lads_exporter.config import UserError
from lads_exporter.dataset import sha256

SEEN = {"channel": "camera", "widths": [4, 8], "hidden": [16], "features": 8, "state_weight": 1.0, "jitter": 0.02, "turn_degrees": 5.0, "shift": 0.05, "scale": 0.05, "frames": config.NO_STAGE}
RENDERING = {"size": [12, 16], "view": {"camera": "front"}}


def write_frames(path, data, count=None, **metadata):
    """Frames whose colours tell the state, in the form of `lads-run frames`."""
    states = dataset_rows(data)
    count = len(states) if count is None else count
    grid = np.linspace(0, 1, 12 * 16 * 3).reshape(12, 16, 3)
    waves = [np.sin(7 * (i + 1) * grid) for i in range(states.shape[1])]
    drawn = np.clip(128 + 60 * np.tensordot(states[:count], waves, 1), 0, 255).astype(np.uint8)
    fields = {"format": "lads-frames", "version": "1", "dataset_sha256": sha256(data), "rendering": json.dumps(RENDERING), **metadata}
    head = json.dumps({"__metadata__": fields, "frames": {"dtype": "U8", "shape": list(drawn.shape), "data_offsets": [0, drawn.size]}}).encode()
    head += b" " * (-len(head) % 8)
    path.write_bytes(struct.pack("<Q", len(head)) + head + drawn.tobytes())
    return path


def dataset_rows(data):
    from safetensors.numpy import load_file

    return load_file(data)["observations"]


APART = {"steps": 12, "batch": 16, "learning_rate": 1e-3, "warmup": 2, "final": 0.1, "weight_decay": 0.0}


def setting(apart=False, system=None, **training):
    table, *beside = copy.deepcopy(setting_for("staged", **training).tables)
    if system:
        table["system"] = system
    table["images"] = SEEN | ({"frames": APART} if apart else {})
    table["encoder"] |= {"kmeans_step": 5, "observed": 0}
    table["data"]["renoise"] = False
    for stage in ("plans", "low_level", "high_level"):
        table["training"][stage]["steps"] = 12
    return config.from_tables(table, *beside, "test")


@pytest.fixture
def files(tmp_path):
    data = synthetic.write(tmp_path / "tiny.safetensors", setting())
    return data, write_frames(tmp_path / "tiny.frames", data)


def trainer_for(folder, files, apart=False, system=None):
    made = setting(apart, system)
    data = dataset.load(files[0], made, files[1])
    made = dataclasses.replace(made, rendering=data.rendering)
    encoded = language.encode(made.config.language, [row["text"] for row in made.instructions])
    return training.Trainer(made, data, encoded, folder, torch.device("cpu"), 0), made, encoded


def test_a_file_of_frames_reads_back(files):
    data = dataset.load(files[0], setting(), files[1])
    assert data.frames.shape == (int(data.offsets[-1]), 12, 16, 3) and data.rendering == RENDERING
    assert np.array_equal(data.frame_rows, np.arange(len(data.frames)))


@pytest.mark.parametrize("spoil, wrong", [
    (lambda path, data: path.write_bytes(path.read_bytes()[:-1]), "not a whole"),
    (lambda path, data: path.write_bytes(b"no"), "no frames"),
    (lambda path, data: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(64)), "no frames"),
    (lambda path, data: path.write_bytes(b"\xff" * 64), "no frames"),
    (lambda path, data: path.write_bytes(path.read_bytes()[:-1]), "not a whole"),
    (lambda path, data: write_frames(path, data, dataset_sha256="00"), "another dataset"),
    (lambda path, data: write_frames(path, data, count=3), "3 frames for"),
    (lambda path, data: path.unlink(), "no frames"),
])  # fmt: skip
def test_other_files_are_refused(files, spoil, wrong):
    spoil(files[1], files[0])
    with pytest.raises(UserError, match=wrong):
        dataset.load(files[0], setting(), files[1])


def test_frames_and_setting_go_together(files):
    with pytest.raises(UserError, match="give those of the dataset with --frames"):
        dataset.load(files[0], setting())
    with pytest.raises(UserError, match="leave --frames out"):
        dataset.load(files[0], setting_for("staged"), files[1])
    table, *beside = setting().tables
    with pytest.raises(UserError, match="schedule staged"):
        config.from_tables(config.layered(table, {"training": {"schedule": "joint"}}), *beside, "test")


def test_augmentation_changes_all_frames_of_an_owner_alike():
    images = config.Images(**SEEN | {"turn_degrees": 20.0, "shift": 0.1, "scale": 0.1})
    still = dataclasses.replace(images, jitter=0.0, turn_degrees=0.0, shift=0.0, scale=0.0)
    drawn = torch.randint(256, (3, 12, 16, 3), dtype=torch.uint8)
    drawn[1] = drawn[0]
    owners = torch.tensor([0, 0, 1])
    assert torch.allclose(frames.augmented(drawn, owners, 2, still), drawn.float(), atol=1e-3)
    torch.manual_seed(1)
    changed = frames.augmented(drawn, owners, 2, images)
    assert torch.equal(changed[0], changed[1]) and not torch.allclose(changed[0], drawn[0].float(), atol=3)
    assert 0 <= changed.min() and changed.max() <= 255
    # Grey has no hue: only its brightness may change.
    grey = frames.augmented(torch.full((1, 12, 16, 3), 100, dtype=torch.uint8), torch.tensor([0]), 1, dataclasses.replace(still, jitter=0.02))
    assert torch.allclose(grey[..., 0], grey[..., 2], atol=1e-2) and 97 < grey.min() <= grey.max() < 103


def test_a_run_ends_in_a_bundle_that_acts_as_its_networks(tmp_path, files):
    trainer, made, encoded = trainer_for(tmp_path / "run", files)
    assert trainer.run(quiet=True)
    columns = [row for row in trainer.curves if row["stage"] == "plans"]
    assert columns[-1]["state"] and columns[-1]["val_state"]

    saved, loaded = training.load_run(tmp_path / "run")
    assert loaded.rendering == RENDERING
    networks = systems.of(loaded.config).Networks(loaded, encoded)
    networks.load_state_dict(saved["networks"])
    candidates = [(instruction, drawn.numpy()) for instruction, drawn in saved["golden"]]
    assert candidates[0][1].dtype == np.uint8
    model = systems.of(loaded.config).export(networks.eval(), loaded, encoded).model
    provenance = {"dataset_sha256": "", "seed": 0, "steps": {}}
    whole = bundle.assemble(networks, loaded, encoded, provenance, wide(candidates, networks))
    found = contracts.of(whole)
    assert found["family"]["features"] == 8 and len(model.graph.node) == len(whole.graph.node)
    (camera,) = contracts.of_role(found, "observation")
    assert (camera["name"], camera["dtype"], camera["shape"], camera["rendering"]) == ("camera", "u8", [12, 16, 3], RENDERING)

    runner = twin.Twin(whole)
    instruction, drawn = candidates[0]
    runner.set_instruction(instruction)
    words = [torch.from_numpy(encoded.instructions[instruction].words)]
    seen, actions = [], []
    with torch.no_grad():
        for frame in drawn[: runner.steps]:
            seen.append(networks.frames(torch.from_numpy(frame)[None])[0])
            before = torch.stack([*actions, torch.zeros(made.action_len)])[None]
            logits = networks.high_level(words, torch.stack(seen)[None], before)[0, -1]
            action, index = runner.step({"camera": frame})
            if (len(seen) - 1) % made.config.encoder.horizon == 0:
                assert np.allclose(runner.logits, logits.numpy(), atol=1e-3)
            wanted = networks.low_level(seen[-1][None], networks.codebook.codes[index][None])[0].numpy()
            low, high = contracts.limits(contracts.action(found))
            assert np.allclose(action, np.clip(wanted, low, high), atol=1e-4)
            actions.append(torch.from_numpy(action))


def wide(candidates, networks):
    """Few steps of training decide by little, and a golden episode needs a margin."""
    with torch.no_grad():
        networks.high_level.head.weight.mul_(30)
    return candidates


def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, files):
    whole, _, _ = trainer_for(tmp_path / "whole", files)
    assert whole.run(quiet=True)
    first, _, _ = trainer_for(tmp_path / "parts", files)
    interrupt(first, ("low_level", 4))
    again, _, _ = trainer_for(tmp_path / "parts", files)
    assert again.run(resume=True, quiet=True)
    assert_same_weights(whole, again)


def test_an_encoder_that_learns_by_itself_stays_as_it_is_afterwards(tmp_path, files):
    """And the state that it tells comes nearer to the one that the frames show."""
    trainer, _, _ = trainer_for(tmp_path / "run", files, apart=True)
    kept = {}
    begin = trainer.system.begin

    def beginning(stage):
        kept[stage] = copy.deepcopy(trainer.networks.frames.state_dict())
        begin(stage)

    trainer.system.begin = beginning
    before = trainer.system.validate("frames")["val_state"]
    assert trainer.run(quiet=True)
    assert list(kept) == ["frames", "plans", "low_level", "high_level"]
    moved = lambda a, b: any(not torch.equal(a[name], b[name]) for name in a)
    assert moved(kept["frames"], kept["plans"])
    assert not moved(kept["plans"], trainer.networks.frames.state_dict())
    told = [row for row in trainer.curves if row["stage"] == "frames"][-1]
    assert float(told["val_state"]) < before
    assert training.load_run(tmp_path / "run")[1].config.images.frames.steps == APART["steps"]


SYSTEMS = {
    "wo_cp": {"kind": "lads", "regressed": True},
    "vae": {"kind": "vae", "beta": 1e-3, "rule": "mean"},
    "lang_dt": {"kind": "lang_dt"},
    "lisa": {"kind": "lisa", "low_level_layers": 1, "option_gradient": "first"},
}


@pytest.mark.parametrize("name", list(SYSTEMS))
def test_other_systems_observe_by_the_same_encoder(tmp_path, files, name):
    """Tests that a system's encoder is LADS' own, trained here or taken from a file, and that its bundle acts as its networks do."""
    shared = tmp_path / "encoder.pt"
    first, _, _ = trainer_for(tmp_path / "lads", files, apart=True)
    assert first.run(quiet=True, encoder=shared)
    own, _, _ = trainer_for(tmp_path / "own", files, True, SYSTEMS[name])
    assert own.run(quiet=True)
    taken, made, encoded = trainer_for(tmp_path / "taken", files, True, SYSTEMS[name])
    assert taken.run(quiet=True, encoder=shared)
    assert_same_weights(own, taken)
    assert all(torch.equal(value, taken.networks.frames.state_dict()[key]) for key, value in first.networks.frames.state_dict().items())
    assert "frames" not in {row["stage"] for row in taken.curves}

    (saved, loaded), provenance = training.load_run(tmp_path / "taken"), {"dataset_sha256": "", "seed": 0, "steps": {}}
    candidates = [(instruction, drawn.numpy()) for instruction, drawn in saved["golden"]]
    networks = taken.networks.eval()
    if name != "lang_dt":
        with torch.no_grad():
            networks.high_level.head.weight.mul_(30)
    model = bundle.assemble(networks, loaded, encoded, provenance, candidates)
    contract = contracts.of(model)
    assert contract["family"]["features"] == 8 and not any(row["role"] == "demonstration" for row in contract["channels"])
    runner, (instruction, drawn) = twin.Twin(model), candidates[0]
    words = [torch.from_numpy(row.words) for row in encoded.instructions]
    policy = whole.of_networks(networks, loaded, encoded, contract, words)
    policy.start(instruction)
    runner.set_instruction(instruction)
    for frame in drawn[: runner.steps]:
        action, _ = runner.step({"camera": frame})
        assert np.abs(policy.act(frame.copy()) - action).max() < 1e-4
        policy.actions[-1] = torch.from_numpy(action.copy())


def test_a_file_of_another_encoder_is_refused(tmp_path, files):
    trainer, _, _ = trainer_for(tmp_path / "run", files, apart=True)
    shared = tmp_path / "encoder.pt"
    shared.write_bytes(b"no encoder")
    for text in (b"no encoder", b"rown ] fox jumps"):
        shared.write_bytes(text)
        with pytest.raises(UserError, match="encoder.pt: no encoder of frames"):
            trainer.run(quiet=True, encoder=shared)
        assert shared.read_bytes() == text
    made_of = training.SharedEncoder(shared, trainer).made_of
    frames_of, state = (getattr(trainer.networks, name).state_dict() for name in ("frames", "state"))
    broken = {name: value * math.nan for name, value in frames_of.items()}
    for weights, wrong in (({}, "its weights are not those of its configuration"), (None, "its weights are not"), (broken, "a weight is not a finite number")):
        torch.save({"made_of": made_of, "frames": weights, "state": state, "seconds": 1.0}, shared)
        with pytest.raises(UserError, match=f"encoder.pt: {wrong}"):
            trainer.run(quiet=True, encoder=shared)
    torch.save({"made_of": "something else", "frames": {}, "state": {}, "seconds": 1.0}, shared)
    with pytest.raises(UserError, match="encoder.pt: its encoder was made with another configuration"):
        trainer.run(quiet=True, encoder=shared)
    live, _, _ = trainer_for(tmp_path / "live", files)
    with pytest.raises(UserError, match="has no encoder of frames that learns in a stage of its own"):
        live.run(quiet=True, encoder=shared)


def test_what_does_not_see_is_named():
    table, *beside = copy.deepcopy(setting().tables)
    for system, wrong in (({"kind": "cluster", "points": 9, "perplexity": 3.0}, "system cluster does not see; those that do: lads"), (SYSTEMS["lang_dt"], "others need images.frames.steps above 0")):
        with pytest.raises(UserError, match=wrong):
            config.from_tables(table | {"system": system}, *beside, "test")
