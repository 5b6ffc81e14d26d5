"""Tests training on a tiny synthetic dataset: losses fall, a resumed run equals an uninterrupted one, the commands work."""

import copy
import csv
import json
import os
import signal
import subprocess
import sys

import numpy as np
import onnx
import pytest
import synthetic
import torch
from resuming import assert_same_weights, interrupt

from lads_exporter import config, dataset, language
from lads_exporter.config import UserError
from lads_exporter.training import Stage, Trainer, load_run

STEPS = {"joint": 150, "plans": 120, "low_level": 60, "high_level": 60}


def setting_for(schedule, **training):
    tables = copy.deepcopy(config.load("configs/tiny.toml").tables)
    tables[0]["training"] |= {"schedule": schedule, **training}
    tables[0]["encoder"]["kmeans_step"] = 30
    for name, steps in STEPS.items():
        tables[0]["training"][name] |= {"steps": steps, "batch": 8 if name != "low_level" else 64, "learning_rate": 5e-3, "warmup": 10}
    return config.from_tables(*tables, "test")


def trainer_for(folder, setting, seed=0):
    path = folder.parent / "tiny.safetensors"
    data = dataset.load(path if path.exists() else synthetic.write(path, setting), setting)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    return Trainer(setting, data, encoded, folder, torch.device("cpu"), seed)


def curve(folder, stage, column):
    with open(folder / "curves.csv") as file:
        return [float(row[column]) for row in csv.DictReader(file) if row["stage"] == stage and row[column]]


@pytest.mark.parametrize("schedule", ["joint", "staged"])
@pytest.mark.parametrize("ce_at", ["all", "decisions"])
def test_losses_fall(tmp_path, schedule, ce_at):
    setting = setting_for(schedule, ce_at=ce_at)
    assert trainer_for(tmp_path / "run", setting).run(quiet=True)
    plans, high = ("joint", "joint") if schedule == "joint" else ("plans", "high_level")
    first, last = curve(tmp_path / "run", plans, "bc")[0], curve(tmp_path / "run", "low_level" if schedule == "staged" else plans, "bc")[-1]
    assert last < 0.5 * first
    assert curve(tmp_path / "run", high, "ce")[-1] < 0.9 * curve(tmp_path / "run", high, "ce")[0]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["perplexity"] >= 0.6 * setting.config.encoder.codebook_size


def test_joint_step_moves_everything_and_the_stages_only_their_part(tmp_path):
    trainer = trainer_for(tmp_path / "run", setting_for("joint"))
    moved = {}
    for name in ("joint", "plans", "low_level", "high_level"):
        stage = Stage(name, trainer)
        if name == "joint":
            for step in range(32):
                stage.advance(step)
        before = {key: value.clone() for key, value in trainer.networks.state_dict().items()}
        stage.advance(40)
        after = trainer.networks.state_dict()
        moved[name] = {key.split(".")[0] for key in after if not torch.equal(before[key], after[key])}
    everything = {"encoder", "codebook", "low_level", "alignment", "high_level"}
    assert moved["joint"] == everything
    assert moved["plans"] == everything - {"high_level"}
    assert moved["low_level"] == {"low_level"}
    assert moved["high_level"] == {"high_level"}


def test_cross_entropy_does_not_move_the_plans(tmp_path):
    """Tests the stop-gradient of equation 7."""
    trainer = trainer_for(tmp_path / "run", setting_for("joint"))
    stage = Stage("joint", trainer)
    for step in range(32):
        stage.advance(step)
    trainer.networks.zero_grad()
    episodes = trainer.corpus.train[:4]
    parts, codes = trainer.system.plans(episodes, torch.tensor([0, 1, 2, 3]))
    assert (codes >= 0).sum(1).tolist() == [-(-(int(n) - k) // 4) for k, n in enumerate(trainer.corpus.lengths[episodes])]
    trainer.system.high_level(episodes, codes)[0].backward()
    assert all(value.grad is None for value in trainer.networks.encoder.parameters())
    assert any(value.grad.abs().max() > 0 for value in trainer.networks.high_level.parameters())


def test_trajectories_longer_than_the_context_are_cut_where_the_controller_restarts_it(tmp_path):
    setting = setting_for("staged")
    setting.tables[0]["high_level"]["context_steps"] = 12
    trainer = trainer_for(tmp_path / "run", config.from_tables(*setting.tables, "test"))
    trainer.networks.eval()
    corpus, high_level = trainer.corpus, trainer.networks.high_level
    episodes = corpus.validation.repeat(2)
    codes = torch.randint(5, (len(episodes), corpus.steps))
    losses, hits = [], []
    for row, episode in enumerate(episodes.tolist()):
        length = int(corpus.lengths[episode])
        assert length > 12
        codes[row, length:] = -1
        words = [corpus.words[corpus.instruction[episode]]]
        for start in range(0, length, 12):
            part = slice(start, min(start + 12, length))
            logits = high_level(words, corpus.observations[[episode], part], corpus.executed[[episode], part])[0]
            losses.append(torch.nn.functional.cross_entropy(logits, codes[row, part], reduction="none"))
            hits.append(logits.argmax(-1) == codes[row, part])
    trainer.system.autocast = False
    loss, accuracy = trainer.system.high_level(episodes, codes)
    torch.testing.assert_close(loss, torch.cat(losses).mean())
    torch.testing.assert_close(accuracy, torch.cat(hits).float().mean())


def test_episodes_that_are_too_long_are_refused(tmp_path):
    setting = setting_for("staged")
    path = synthetic.write(tmp_path / "tiny.safetensors", setting)
    for table, key, value, named in (("alignment", "segments", 2, "alignment.segments"), ("high_level", "context_steps", 8, "context_steps")):
        tables = copy.deepcopy(setting.tables)
        tables[0]["beyond_context"] = "refuse"
        tables[0][table][key] = value
        with pytest.raises(UserError, match=named):
            dataset.load(path, config.from_tables(*tables, "test"))


@pytest.mark.parametrize(("schedule", "stop_at"), [("joint", 40), ("staged", 70), ("staged", 130), ("staged", 200)])
def test_resumed_run_equals_an_uninterrupted_one(tmp_path, schedule, stop_at):
    setting = setting_for(schedule)
    whole = trainer_for(tmp_path / "whole", setting)
    assert whole.run(quiet=True)
    part = trainer_for(tmp_path / "part", setting)
    interrupt(part, stop_at)
    with pytest.raises(UserError, match="not finished"):
        load_run(tmp_path / "part")
    resumed = trainer_for(tmp_path / "part", setting)
    with pytest.raises(UserError, match="--resume"):
        resumed.run(quiet=True)
    assert resumed.run(resume=True, quiet=True)
    assert_same_weights(whole, resumed)


def test_an_export_may_change_how_a_run_acts_and_not_what_it_was_trained_with(tmp_path):
    setting = setting_for("joint")
    setting.tables[0]["training"]["joint"]["steps"] = 2
    trainer = trainer_for(tmp_path / "run", config.from_tables(*setting.tables, "test"))
    assert trainer.run(quiet=True)
    over = tmp_path / "over.toml"
    over.write_text('decision = "sample"\n[system]\nkind = "lads"\nregressed = false\n')
    assert load_run(tmp_path / "run", over)[1].config.decision == "sample"
    over.write_text('[system]\nkind = "lisa"\nlow_level_layers = 1\noption_gradient = "all"\n[training.joint]\nsteps = 7\n')
    wrong = r"over.toml: changes system.kind, system.regressed, system.low_level_layers, system.option_gradient, training.joint.steps, on which the trained weights depend"
    with pytest.raises(UserError, match=wrong):
        load_run(tmp_path / "run", over)


def test_a_signal_ends_in_a_checkpoint(tmp_path):
    trainer = trainer_for(tmp_path / "run", setting_for("joint"))
    original = Stage.advance

    def interrupted(stage, step):
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(stage, step)

    Stage.advance = interrupted
    try:
        assert not trainer.run(quiet=True)
    finally:
        Stage.advance = original
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert saved["position"] == {"stage": 0, "step": 4}
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_resume_refuses_another_configuration(tmp_path):
    trainer = trainer_for(tmp_path / "run", setting_for("joint"))
    trainer.save(None)
    other = trainer_for(tmp_path / "run", setting_for("joint", clip=2.0))
    with pytest.raises(UserError, match="another tables"):
        other.run(resume=True, quiet=True)


def test_fresh_noise_and_word_dropout(tmp_path):
    trainer = trainer_for(tmp_path / "run", setting_for("joint"))
    corpus = trainer.corpus
    at = corpus.train[:6], torch.arange(6)
    first, second = corpus.shown(*at), corpus.shown(*at)
    assert not torch.equal(first, second)
    assert ((first - corpus.states[at]).abs() <= corpus.noise + 1e-6).all()
    tables = copy.deepcopy(trainer.setting.tables)
    tables[0]["data"]["word_dropout"] = 0.5
    contexts = trainer.system.contexts
    contexts.config = config.from_tables(*tables, "test").config
    words = corpus.words[0]
    lengths = {len(contexts.some_words(words)) for _ in range(50)}
    assert len(lengths) > 2 and max(lengths) <= len(words)
    assert all(torch.equal(contexts.some_words(words)[-1], words[-1]) for _ in range(20))
    codes = torch.zeros(6, corpus.steps, dtype=torch.long)
    shown, same = contexts.instructions(corpus.train[:6], codes, training=False)
    assert same is codes
    assert all(row is corpus.words[i] for row, i in zip(shown, corpus.instruction[corpus.train[:6]]))


def test_batches_of_similar_length_use_every_drawn_episode(tmp_path):
    corpus = trainer_for(tmp_path / "run", setting_for("joint")).corpus
    generator_of = lambda draw: torch.Generator().manual_seed(draw + 5)
    batches = torch.stack([corpus.draw_alike(4, step, generator_of) for step in range(8)])
    pool = corpus.draw_pool(4, generator_of(0))
    assert batches.flatten().sort().values.tolist() == pool.flatten().sort().values.tolist()


def run_command(*arguments, folder=None):
    command = [sys.executable, "-m", "lads_exporter", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(config.find("pyproject.toml").resolve().parent)}
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)


def test_commands_from_dataset_to_bundle(tmp_path):
    setting = config.load("configs/tiny.toml")
    data = synthetic.write(tmp_path / "tiny.safetensors", setting)
    tables = setting.tables
    folder = config.find("configs/tiny.toml").resolve().parent
    short = (folder / "tiny.toml").read_text().replace("tiny.", f"{folder}/tiny.")
    for name in ("plans", "low_level", "high_level"):
        steps = tables[0]["training"][name]["steps"]
        short = short.replace(f"[training.{name}]\nsteps = {steps}", f"[training.{name}]\nsteps = 80")
    (tmp_path / "short.toml").write_text(short.replace("kmeans_step = 200", "kmeans_step = 30"))
    out = run_command("train", "--config", tmp_path / "short.toml", "--data", data, "--out", tmp_path / "run", "--threads", 1)
    assert out.returncode == 0, out.stderr
    out = run_command("export", "--run", tmp_path / "run", "-o", tmp_path / "tiny.onnx")
    assert out.returncode == 0, out.stderr
    onnx.checker.check_model(onnx.load(tmp_path / "tiny.onnx"), full_check=True)
    sha256 = out.stdout.split("sha256 ")[1].split()[0]
    card = (tmp_path / "tiny.md").read_text()
    assert sha256 in card and "Not measured yet" in card
    split = {"episodes": 4, "n_rate": 3.5, "k_rate": [1, 1, 0.75, None], "full_success": 0.75}
    split |= {"full_success_interval": [0.3, 0.95], "un_instructed": 2}
    done = {"completions": [{"sub_task": "drawer", "count": 3}], "un_instructed_completions": []}
    instructions = [{"id": "dl", "text": "", "split": "seen", "episodes": 4, "n_rate": 3.5} | done]
    splits = {"seen": split, "unseen": split}
    results = {"bundle_sha256": sha256, "seed": 1, "noise": "v0", "splits": splits, "instructions": instructions}
    (tmp_path / "results.json").write_text(json.dumps(results))
    arguments = ("card", "--run", tmp_path / "run", "-o", tmp_path / "tiny.onnx", "--results")
    out = run_command(*arguments, tmp_path / "results.json")
    assert out.returncode == 0, out.stderr
    card = (tmp_path / "tiny.md").read_text()
    assert "| seen | 4 | 3.50 | 1.00 1.00 0.75 - | 0.75 (0.30-0.95) | 2 |" in card
    assert "| dl | seen | 4 | 3.50 | drawer 3 |  |" in card
    (tmp_path / "other.json").write_text(json.dumps(results | {"bundle_sha256": "0"}))
    out = run_command(*arguments, tmp_path / "other.json")
    assert out.returncode == 2 and "another bundle" in out.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "--config", "configs/tiny.toml", "--data", "absent.safetensors", "--out", "x"), "no dataset at absent"),
        (("train", "--config", "absent.toml", "--data", "a", "--out", "x"), "no such file"),
        (("export", "--run", "absent", "-o", "x.onnx"), "no run in absent"),
        (("random", "--config", "pyproject.toml", "-o", "x.onnx"), "environment"),
    ],
)
def test_bad_input_ends_with_one_line(tmp_path, arguments, message):
    out = run_command(*arguments, folder=tmp_path)
    assert out.returncode == 2
    assert message in out.stderr and out.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_unknown_and_missing_keys_are_named():
    tables = copy.deepcopy(config.load("configs/tiny.toml").tables)
    tables[0]["encoder"]["horizn"] = 5
    with pytest.raises(UserError, match="horizn"):
        config.from_tables(*tables, "test")
    del tables[0]["encoder"]["horizn"], tables[0]["encoder"]["horizon"]
    with pytest.raises(UserError, match="'horizon' is missing"):
        config.from_tables(*tables, "test")


@pytest.mark.parametrize("steps", [10, 0])
def test_a_context_off_the_grid_of_plans_is_refused(steps):
    tables = copy.deepcopy(config.load("configs/tiny.toml").tables)
    tables[0]["high_level"]["context_steps"] = steps
    with pytest.raises(UserError, match=f"context_steps = {steps} is not a multiple of the plan period of 4"):
        config.from_tables(*tables, "test")


@pytest.mark.parametrize("name", ["kitchen", "kitchen-paper", "tiny"])
def test_shipped_configurations_load(name):
    setting = config.load(f"configs/{name}.toml")
    assert setting.config.name == name
    if name == "kitchen-paper":
        encoder, stage = setting.config.encoder, setting.config.training.joint
        assert (encoder.codebook_size, encoder.codebook_dim, encoder.horizon, encoder.ema) == (20, 16, 20, 0.99)
        assert setting.config.training.schedule == "joint" and stage.batch == 16


def test_word_embeddings_of_the_shipped_language_encoder():
    setting = config.load("configs/kitchen.toml")
    texts = [row["text"] for row in setting.instructions[:2]]
    last = language.encode(setting.config.language, texts)
    assert last.dim == 384 and all(len(row.words) >= len(text.split()) + 1 for row, text in zip(last.instructions, texts))
    assert last.instructions[0].sentence.shape == (384,)
    other = language.encode(config.Language(setting.config.language.encoder, 2, False), texts)
    assert np.abs(other.instructions[0].words - last.instructions[0].words).max() > 0.1
    with pytest.raises(UserError, match="no folder"):
        language.encode(config.Language("/absent", -1, False), texts)
