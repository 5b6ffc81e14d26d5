"""Frozen features: drawn and encoded in parts by a stand-in for lads-run, then LADS with a history on them and other systems, to bundles that act as
their networks do."""

import copy
import dataclasses
import json
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from resuming import assert_same_weights, interrupt
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from test_training import setting_for

from lads_exporter import __main__ as command, bundle, config, contract as contracts, dataset, feature_corpus, features, language, systems, training, twin, whole
from lads_exporter.config import UserError

SIZE, F, JOINTS = [16, 20], 48, 2
RENDERING = {"size": SIZE, "view": {"camera": "front"}}
SEEN = {"channel": "camera", "encoder": "random-4", "features": F, "joints": JOINTS, "std_floor": 0.1, "clip": 4.0}
HISTORY = {"window": 3, "layers": 1, "heads": 2, "dropout": 0.1}
# Draws frames whose colours tell the state, as `lads-run frames` would, and counts its calls.
PROGRAM = f'''#!{sys.executable}
import hashlib, json, struct, sys
import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file
assert sys.argv[1] == "frames" and sys.argv[3] == "-o"
with open(__file__ + ".calls", "a") as calls:
    calls.write("x")
states = load_file(sys.argv[2])["states"]
grid = np.linspace(0, 1, {SIZE[0] * SIZE[1] * 3}).reshape({SIZE[0]}, {SIZE[1]}, 3)
waves = [np.sin(7 * (i + 1) * grid) for i in range(states.shape[1])]
drawn = np.clip(128 + 60 * np.tensordot(states, waves, 1), 0, 255).astype(np.uint8)
made_of = hashlib.sha256(open(sys.argv[2], "rb").read()).hexdigest()
fields = dict(format="lads-frames", version="1", dataset_sha256=made_of, rendering=json.dumps({RENDERING!r}))
head = json.dumps({{"__metadata__": fields, "frames": {{"dtype": "U8", "shape": list(drawn.shape), "data_offsets": [0, drawn.size]}}}}).encode()
head += b" " * (-len(head) % 8)
open(sys.argv[4], "wb").write(struct.pack("<Q", len(head)) + head + drawn.tobytes())
'''


def setting(**over):
    table, *beside = copy.deepcopy(setting_for("staged").tables)
    table |= {"pretrained": SEEN, "history": HISTORY}
    table["encoder"] |= {"kmeans_step": 5, "observed": JOINTS}
    table["data"]["renoise"] = True
    for stage in ("plans", "low_level", "high_level"):
        table["training"][stage]["steps"] = 12
    return config.from_tables(config.layered(table, over), *beside, "test")


@pytest.fixture
def program(tmp_path, monkeypatch):
    monkeypatch.setattr(features, "PART", 100)
    path = tmp_path / "lads-run"
    path.write_text(PROGRAM)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture
def files(tmp_path, program):
    data = synthetic.write(tmp_path / "tiny.safetensors", setting())
    features.make(setting(), data, tmp_path / "tiny.features", program, quiet=True)
    return data, tmp_path / "tiny.features"


def calls(program):
    return len(Path(f"{program}.calls").read_text())


def load(files, made=None):
    made = made or setting()
    return features.attach(dataset.load(files[0], made), made, files[1])


def test_features_are_the_encoders_of_every_state(files, program):
    data = load(files)
    total = int(data.offsets[-1])
    assert data.features.rows.shape == (total, F) and data.features.rows.dtype == np.float16
    assert data.rendering == RENDERING and calls(program) == -(-total // 100)
    # Every step's own: the frame that is kept of a step gives the step's row.
    encode = features.Encoder(setting(), RENDERING)
    for step, frame in list(data.features.frames.items())[::7]:
        assert np.array_equal(encode(frame[None])[0], data.features.rows[step])
    kept = {step for _, rows in features.golden_episodes(data, setting()) for step in range(rows.start, rows.stop)}
    assert set(data.features.frames) == kept and len(kept) > 5


def contents(path):
    with safe_open(path, "numpy") as file:
        return file.metadata(), {name: file.get_tensor(name).tobytes() for name in file.keys()}


def test_what_was_stopped_goes_on_and_gives_the_same(tmp_path, files, program, monkeypatch):
    whole, drawn, done = contents(files[1]), features._draw, calls(program)
    counted = []

    def stopping(*arguments):
        if len(counted) == 1:
            raise KeyboardInterrupt
        counted.append(1)
        return drawn(*arguments)

    monkeypatch.setattr(features, "_draw", stopping)
    path = tmp_path / "again.features"
    with pytest.raises(KeyboardInterrupt):
        features.make(setting(), files[0], path, program, quiet=True)
    assert not path.exists() and len(list(Path(f"{path}.parts").iterdir())) == 1
    monkeypatch.setattr(features, "_draw", drawn)
    features.make(setting(), files[0], path, program, quiet=True)
    assert contents(path) == whole and not Path(f"{path}.parts").exists()
    assert calls(program) == 2 * done
    features.make(setting(), files[0], path, program, quiet=True)  # it is whole: nothing is drawn
    assert calls(program) == 2 * done


def test_parts_of_something_else_do_not_come_together(tmp_path, files, program):
    path = tmp_path / "other.features"
    folder = Path(f"{path}.parts")
    folder.mkdir()
    one = load_file(files[1])
    said = {"format": "lads-features", "version": "1", "dataset_sha256": "00", "rendering": "{}", "encoder": "random-4", "encoder_sha256": "00"}
    save_file({name: rows[:1] for name, rows in one.items()}, folder / "00000.safetensors", metadata=said)
    with pytest.raises(UserError, match="its parts are of different datasets"):
        features.make(setting(), files[0], path, program, quiet=True)
    assert not path.exists()
    (folder / "00000.safetensors").write_bytes(b"torn")
    with pytest.raises(UserError, match="00000.safetensors: damaged"):
        features.make(setting(), files[0], path, program, quiet=True)


@pytest.mark.parametrize("spoil, wrong", [
    (lambda path, data: path.write_bytes(path.read_bytes()[:-1]), "no features"),
    (lambda path, data: path.write_bytes(b"no"), "no features"),
    (lambda path, data: path.unlink(), "no features"),
    (lambda path, data: data.write_bytes(data.read_bytes() + b" "), "not a lads-dataset file|another dataset"),
])  # fmt: skip
def test_other_files_are_refused(files, spoil, wrong):
    spoil(files[1], files[0])
    with pytest.raises(UserError, match=wrong):
        load(files)


def test_features_of_another_encoder_or_width_are_refused(files):
    table, *beside = setting().tables
    other = config.from_tables(config.layered(table, {"pretrained": {"encoder": "random-5", "features": 60}}), *beside, "test")
    with pytest.raises(UserError, match=r"made by the encoder random-4.*; has the shape .* says 60 features; make it anew"):
        load(files, other)


def test_features_and_setting_go_together(files):
    with pytest.raises(UserError, match="give those of the dataset with --features"):
        load((files[0], None))
    with pytest.raises(UserError, match="leave --features out"):
        load(files, setting_for("staged"))


@pytest.mark.parametrize("over, wrong", [
    ({"history": {"window": 0}}, "go together in system lads; history.window = 0 must be positive"),
    ({"system": {"kind": "lang_dt"}}, "system lang_dt has no low level: history.window = 0 is needed"),
    ({"system": {"kind": "cluster", "points": 100, "perplexity": 5.0}}, "they go with the systems lads, vae, lang_dt, lisa, not cluster"),
    ({"pretrained": {"joints": 9, "clip": 0.0}}, "joints = 9 must be 1 to 5, the elements of the state; .*clip must be positive"),
    ({"history": {"heads": 3}}, "multiple of history.heads"),
    ({"training": {"schedule": "joint"}}, "schedule staged"),
])  # fmt: skip
def test_settings_that_do_not_fit_are_refused(over, wrong):
    with pytest.raises(UserError, match=wrong):
        setting(**over)


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["lads_exporter", *map(str, arguments)])
    return command.main()


def test_the_command_makes_them_and_refuses_a_setting_without_an_encoder(tmp_path, files, program, monkeypatch, capsys):
    over = tmp_path / "over.toml"
    row = lambda table: "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())
    over.write_text(f"[encoder]\nobserved = {JOINTS}\n[pretrained]\n{row(SEEN)}\n[history]\n{row(HISTORY)}\n[training]\nschedule = 'staged'\n")
    path = tmp_path / "by-command.features"
    asked = ["features", "--config", "configs/tiny.toml", "--data", files[0], "-o", path, "--lads-run", program]
    assert run(monkeypatch, *asked) == 2 and "has no frozen encoder" in capsys.readouterr().err and not path.exists()
    assert run(monkeypatch, *asked, "--system", over) == 0
    assert contents(path) == contents(files[1])


def test_a_program_that_fails_is_named_with_what_it_says(tmp_path, files, program):
    with pytest.raises(UserError, match="nowhere: .*build it: cargo build"):
        features.make(setting(), files[0], tmp_path / "a.features", tmp_path / "nowhere", quiet=True)
    program.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('error: no EGL here')\n")
    with pytest.raises(UserError, match="lads-run frames: error: no EGL here"):
        features.make(setting(), files[0], tmp_path / "a.features", program, quiet=True)
    assert not (tmp_path / "a.features").exists()


def test_a_std_has_a_floor_and_values_a_bound():
    rows = np.random.default_rng(0).standard_normal((500, 6)).astype(np.float16)
    rows[:, 0] *= 0.001
    mean, std = feature_corpus.statistics(rows, np.arange(400), 0.1)
    wanted = rows[:400].astype(np.float64)
    assert np.allclose(mean, wanted.mean(0), atol=1e-6) and np.allclose(std[1:], wanted.std(0)[1:], rtol=1e-5)
    assert np.isclose(std[0], 0.1 * np.median(wanted.std(0)), rtol=1e-5)


def trainer_for(folder, files, **over):
    made = setting(**over)
    data = load(files, made)
    made = dataclasses.replace(made, rendering=data.rendering)
    encoded = language.encode(made.config.language, [row["text"] for row in made.instructions])
    return training.Trainer(made, data, encoded, folder, torch.device("cpu"), 0), made, encoded


def test_the_low_level_in_batches_is_the_one_of_single_plans(tmp_path, files):
    trainer, made, _ = trainer_for(tmp_path / "run", files)
    networks, corpus = trainer.networks.eval(), trainer.corpus
    corpus.clean = None  # no fresh noise
    low, acting = networks.low_level, networks.acting_low_level()
    episodes, starts, codes = torch.tensor([0, 1, 1, 3]), torch.tensor([0, 2, 5, 7]), torch.tensor([0, 1, 0, 1])
    found = []
    keep = lambda *given: found.append(given) or original(*given)
    original, low.chunks = low.chunks, keep
    with torch.no_grad():
        trainer.system.autocast = False
        trainer.system.in_windows(episodes, starts, networks.codebook.codes[codes])
        batch = original(*found[0])
        for row, (e, start, code) in enumerate(zip(episodes.tolist(), starts.tolist(), codes.tolist())):
            seen = corpus.observations[e, : start + corpus.horizon]
            before = torch.cat([torch.zeros(1, made.action_len), corpus.executed[e, : start + corpus.horizon - 1]])
            one = acting(code, seen, min(start, low.window), before, corpus.horizon)
            assert torch.allclose(batch[row], one, atol=1e-5)


def test_a_run_ends_in_a_bundle_that_acts_as_its_networks(tmp_path, files):
    trainer, made, encoded = trainer_for(tmp_path / "run", files)
    assert trainer.run(quiet=True)
    saved, loaded = training.load_run(tmp_path / "run")
    assert loaded.rendering == RENDERING
    networks = systems.of(loaded.config).Networks(loaded, encoded)
    networks.load_state_dict(saved["networks"])
    with torch.no_grad():  # few steps of training decide by little, and a golden episode needs a margin
        networks.high_level.head.weight.mul_(30)
    candidates = [(index, {name: rows.numpy() for name, rows in seen.items()}) for index, seen in saved["golden"]]
    assert all(len(rows) <= features.golden_steps(made) for _, seen in candidates for rows in seen.values())
    whole = bundle.assemble(networks, loaded, encoded, {"dataset_sha256": "", "seed": 0, "steps": {}}, candidates)
    found = contracts.of(whole)
    family = found["family"]
    assert (family["kind"], family["features"], family["actions"], family["window"]) == ("history", F + JOINTS, True, HISTORY["window"])
    camera, joints = contracts.of_role(found, "observation")
    assert (camera["name"], camera["shape"], camera["rendering"]) == ("camera", [*SIZE, 3], RENDERING)
    assert [row["name"] for row in joints["elements"]] == ["joint1", "joint2"]

    runner = twin.Twin(whole)
    instruction, seen = candidates[0]
    runner.set_instruction(instruction)
    words = [torch.from_numpy(encoded.instructions[instruction].words)]
    acting, horizon = networks.acting_low_level(), made.config.encoder.horizon
    observed, actions, start = [], [torch.zeros(made.action_len)], 0
    low, high = (torch.tensor(side) for side in contracts.limits(contracts.action(found)))
    with torch.no_grad():
        for t, (frame, own) in enumerate(zip(seen["camera"], seen["observation"])):
            observed.append(networks.frames(torch.from_numpy(own)[None], torch.from_numpy(frame)[None])[0])
            action, index = runner.step({"camera": frame, "observation": own})
            assert np.allclose(runner.states["features"].value[0], observed[-1], atol=1e-5)
            if t % horizon == 0:
                start = t
                logits = networks.high_level(words, torch.stack(observed)[None], torch.stack([*actions[1:], actions[0]])[None])[0, -1]
                assert np.allclose(runner.logits, logits, atol=1e-3)
            wanted = acting(index, torch.stack(observed), min(start, acting.window), torch.stack(actions), t + 1 - start)[-1]
            assert np.allclose(action, wanted.clamp(low, high), atol=1e-5)
            actions.append(torch.from_numpy(action))


OTHERS = {
    "with_vae": {"system": {"kind": "vae", "beta": 5e-4, "rule": "mean"}},
    "vae": {"system": {"kind": "vae", "beta": 5e-4, "rule": "sample"}, "alignment": {"weight": 0.0}},
    "wo_cp": {"system": {"kind": "lads", "regressed": True}},
    "lang_dt": {"system": {"kind": "lang_dt"}, "history": {"window": 0}},
    "lisa": {"system": {"kind": "lisa", "low_level_layers": 1, "option_gradient": "first"}, "history": {"window": 0}},
    "lisa_history": {"system": {"kind": "lisa", "low_level_layers": 0, "option_gradient": "all"}},
}


WITHOUT_CODES = ("with_vae", "vae", "lang_dt")


@pytest.mark.parametrize("name", list(OTHERS))
def test_other_systems_learn_from_the_same_features(tmp_path, files, name):
    """Tests that a system's bundle acts as its networks do, which read the whole sequence."""
    trainer, _, encoded = trainer_for(tmp_path / "run", files, **OTHERS[name])
    assert trainer.run(quiet=True)
    saved, made = training.load_run(tmp_path / "run")
    networks = trainer.networks.eval()
    if name not in WITHOUT_CODES:
        with torch.no_grad():
            networks.high_level.head.weight.mul_(30)
    candidates = [(index, {name: rows.numpy() for name, rows in seen.items()}) for index, seen in saved["golden"]]
    model = bundle.assemble(networks, made, encoded, {"dataset_sha256": "", "seed": 0, "steps": {}}, candidates)
    found = contracts.of(model)
    assert found["family"]["features"] == F + JOINTS and [row["name"] for row in contracts.of_role(found, "observation")] == ["camera", "observation"]

    runner, (instruction, seen) = twin.Twin(model), candidates[0]
    policy = whole.of_networks(networks, made, encoded, found, [torch.from_numpy(row.words) for row in encoded.instructions])
    policy.start(instruction, seed=0)
    runner.set_instruction(instruction)
    runner.reset()
    for step in range(len(seen["observation"])):
        given = {channel: rows[step] for channel, rows in seen.items()}
        action, index = runner.step(given)
        assert np.abs(policy.act(given) - action).max() < 1e-4 and (name in WITHOUT_CODES or policy.plans[-1] == index)
        policy.actions[-1] = torch.from_numpy(action.copy())


def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, files):
    whole, _, _ = trainer_for(tmp_path / "whole", files)
    assert whole.run(quiet=True)
    first, _, _ = trainer_for(tmp_path / "parts", files)
    interrupt(first, ("low_level", 4))
    again, _, _ = trainer_for(tmp_path / "parts", files)
    assert again.run(resume=True, quiet=True)
    assert_same_weights(whole, again)


def test_weights_that_did_not_make_the_features_are_refused(tmp_path, files, monkeypatch):
    tensors = load_file(files[1])
    save_file(tensors, files[1], metadata=contents(files[1])[0] | {"encoder_sha256": "00"})
    with pytest.raises(UserError, match="other weights of random-4"):
        trainer_for(tmp_path / "run", files)
