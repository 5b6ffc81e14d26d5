"""Trains a system: a run is a folder with a checkpoint, the curves, and at the end a summary.

Which stages there are and what each minimises is the system's (`systems`). Every step seeds the random numbers with (seed, stage, step): a
resumed run does what an uninterrupted one would have done. An interrupt finishes the step at hand, writes a checkpoint and stops.
"""

import csv
import dataclasses
import hashlib
import io
import json
import math
import pickle
import signal
import time
import zlib
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from . import __version__, config as configuration, language, systems
from .output import write_atomically
from .config import UserError
from .contract import OBSERVATION
from .corpus import Corpus
from .feature_corpus import FeatureCorpus
from .features import golden_episodes
from .frames import FrameCorpus
from .hindsight import relabel
from .systems.sighted import FRAMES

# What reading a damaged file with PyTorch ends with.
UNREADABLE = (OSError, RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, pickle.UnpicklingError)
LOG_EVERY, VALIDATE_EVERY, SAVE_SECONDS = 50, 500, 120
CHECKPOINT, CURVES, SUMMARY = "checkpoint.pt", "curves.csv", "summary.json"
COLUMNS = ("stage", "step", "learning_rate", "ms_per_step", "loss", "bc", "commitment", "align", "ce", "kl", "noise", "language", "perplexity",
           "revived", "state", "val_state", "val_bc", "val_perplexity", "val_ce", "val_accuracy", "val_kl", "val_noise")  # fmt: skip


@contextmanager
def _matmul_precision(name):
    """Sets the precision of matrix products for a while: "medium" lets matrix products round their inputs to bfloat16 where that is faster;
    sums stay in float32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class Stage:
    """A stage of training: the parameters that it trains, and their optimiser."""

    def __init__(self, name, trainer):
        self.name, self.trainer, self.system = name, trainer, trainer.system
        self.training = trainer.config.training
        self.settings = self.system.settings(trainer.config, name)
        self.modules = [getattr(trainer.networks, part) for part in self.system.parts(name)]
        self.parameters = [value for module in self.modules for value in module.parameters()]
        rate, decay = self.settings.learning_rate, self.settings.weight_decay
        self.optimizer = torch.optim.AdamW(self.parameters, rate, weight_decay=decay, fused=True)
        self.system.begin(name)

    def learning_rate(self, step):
        """Computes the learning rate: linear warm-up, then a cosine down to `final` of the rate."""
        s = self.settings
        cosine = 0.5 * (1 + math.cos(math.pi * step / s.steps))
        return s.learning_rate * min(1.0, (step + 1) / s.warmup) * (s.final + (1 - s.final) * cosine)

    def finish(self):
        self.system.finish(self.name)

    def validate(self):
        return self.system.validate(self.name)

    def advance(self, step):
        """Runs one optimiser step; returns the parts of the loss as numbers."""
        torch.manual_seed(self.trainer.seed_of(self.name, "step", step))
        self.trainer.networks.eval()
        for module in self.modules:
            module.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(step)
        total, parts = self.system.loss(self.name, step)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.training.clip)
        self.optimizer.step()
        self.system.after(self.name)
        numbers = {name: float(torch.as_tensor(value).detach()) for name, value in (parts | {"loss": total}).items()}
        if not math.isfinite(numbers["loss"]):
            raise UserError(f"the loss is no longer finite at step {step} of stage {self.name}; lower its learning_rate")
        return numbers


class Trainer:
    """A training run: a folder with a checkpoint, the curves and at the end a summary."""

    def __init__(self, setting, dataset, encoded, out, device, seed):
        self.setting, self.config, self.out, self.seed = setting, setting.config, Path(out), seed
        self.identity = {
            "tables": setting.tables,
            "dataset_sha256": dataset.sha256,
            "language_sha256": encoded.sha256,
            "seed": seed,
        }
        if dataset.rendering is not None:
            self.identity["rendering"] = dataset.rendering
        if dataset.features is not None:
            self.identity["encoder_sha256"] = dataset.features.encoder
        torch.manual_seed(self.seed_of("", "weights", 0))
        self.networks = systems.of(self.config).Networks(setting, encoded).to(device)
        data = self.config.data
        if data.hindsight > 0:
            dataset = relabel(dataset, setting, data.hindsight, data.hindsight_latest, data.hindsight_most, self.seed_of("", "hindsight", 0))
        own = encoded if dataset.texts is None else language.encode(self.config.language, dataset.texts)
        kind = FeatureCorpus if dataset.features is not None else FrameCorpus if dataset.frames is not None else Corpus
        self.corpus = kind(dataset, setting, own, device)
        self.networks.normalizer.mean.copy_(self.corpus.mean)
        self.networks.normalizer.std.copy_(self.corpus.std)
        self.system = systems.of(self.config).Training(self.networks, self.corpus, setting, self.seed_of)
        self.notes = dataset.notes
        self.golden = golden_candidates(dataset, self.corpus.validation.tolist(), setting)
        self.position = {"stage": 0, "step": 0}
        self.curves, self.seconds = [], {}
        self.stop = False

    def seed_of(self, stage, what, step):
        return zlib.crc32(f"{self.seed} {stage} {what} {step}".encode())

    def resume(self):
        path = self.out / CHECKPOINT
        if not path.is_file():
            raise UserError(f"nothing to resume: {path} does not exist")
        saved = _read(path, self.corpus.device)
        for key, value in self.identity.items():
            if saved["identity"][key] != value:
                raise UserError(f"{path} was made with another {key.removesuffix('_sha256')}; train into a new folder")
        load_networks(self.networks, saved["networks"], path)
        self.position, self.curves, self.seconds = saved["position"], saved["curves"], saved["seconds"]
        return saved["optimizer"]

    def save(self, stage):
        state = {
            "identity": self.identity,
            "position": self.position,
            "networks": self.networks.state_dict(),
            "optimizer": stage.optimizer.state_dict() if stage else None,
            "curves": self.curves,
            "seconds": self.seconds,
            "notes": self.notes,
            "golden": self.golden,
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_atomically(self.out / CHECKPOINT, buffer.getvalue())
        table = io.StringIO()
        writer = csv.DictWriter(table, COLUMNS, restval="")
        writer.writeheader()
        writer.writerows(self.curves)
        write_atomically(self.out / CURVES, table.getvalue().encode())

    def run(self, resume=False, quiet=False, encoder=None):
        """Trains to the end; False when it was interrupted (the checkpoint is then written).

        `encoder`: a file that has the encoder of frames, which is then not trained anew, or gets it when it is trained.
        """
        if not resume and (self.out / CHECKPOINT).exists():
            raise UserError(f"{self.out / CHECKPOINT} exists; continue it with --resume or choose another --out")
        optimizer_state = self.resume() if resume else None
        names = self.system.stages(self.config)
        shared = SharedEncoder(encoder, self) if encoder else None
        if shared and self.position == {"stage": 0, "step": 0} and shared.read():
            self.position = {"stage": 1, "step": 0}
        with self._interruptible(), _matmul_precision("medium" if self.config.training.bf16 else "highest"):
            while self.position["stage"] < len(names):
                name = names[self.position["stage"]]
                stage = Stage(name, self)
                if optimizer_state and self.position["step"]:
                    stage.optimizer.load_state_dict(optimizer_state)
                optimizer_state = None
                if not self._run_stage(stage, quiet):
                    return False
                stage.finish()
                self.position = {"stage": self.position["stage"] + 1, "step": 0}
                self.save(None)
                if shared and name == FRAMES:
                    shared.write()
        self._summarise(names)
        return True

    def _run_stage(self, stage, quiet):
        steps, begun, saved = stage.settings.steps, time.monotonic(), time.monotonic()
        spent = self.seconds.get(stage.name, 0.0)
        sums, latest, counted_from = defaultdict(list), {}, time.monotonic()
        bar = tqdm(total=steps, initial=self.position["step"], desc=stage.name, disable=quiet or None, unit="step")
        with bar:
            while self.position["step"] < steps and not self.stop:
                step = self.position["step"]
                for name, value in stage.advance(step).items():
                    sums[name].append(value)
                self.position["step"] = step + 1
                bar.update()
                if (step + 1) % LOG_EVERY == 0 or step + 1 == steps:
                    row = {"stage": stage.name, "step": step + 1, "learning_rate": f"{stage.learning_rate(step):.3g}"}
                    numbers = {name: sum(values) / len(values) for name, values in sums.items()}
                    numbers["ms_per_step"] = (time.monotonic() - counted_from) * 1000 / len(sums["loss"])
                    if (step + 1) % VALIDATE_EVERY == 0 or step + 1 == steps:
                        latest = stage.validate()
                        numbers |= latest
                    row |= {name: f"{value:.5g}" for name, value in numbers.items()}
                    if self.system.CODEBOOK:
                        row["revived"] = int(self.networks.codebook.revived)
                    self.curves.append(row)
                    shown = ("loss", "bc", "align", "ce", "kl", "noise", "perplexity")
                    bar.set_postfix({name: f"{numbers[name]:.3g}" for name in shown if name in numbers} | _short(latest))
                    sums.clear()
                    counted_from = time.monotonic()
                self.seconds[stage.name] = spent + time.monotonic() - begun
                if time.monotonic() - saved > SAVE_SECONDS:
                    self.save(stage)
                    saved = time.monotonic()
        self.save(stage)
        return self.position["step"] >= steps

    @contextmanager
    def _interruptible(self):
        def handler(number, frame):
            self.stop = True

        try:
            before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:  # not the main thread: signals are somebody else's
            before = {}
        try:
            yield
        finally:
            for number, previous in before.items():
                signal.signal(number, previous)

    def _summarise(self, names):
        last = {}
        for row in self.curves:
            last |= {name: float(value) for name, value in row.items() if name.startswith("val_")}
        summary = {
            "setting": self.config.name,
            "schedule": self.config.training.schedule,
            "seed": self.seed,
            "dataset_sha256": self.identity["dataset_sha256"],
            "episodes": len(self.corpus.lengths),
            "transitions": int(self.corpus.lengths.sum()),
            "steps": {name: self.system.settings(self.config, name).steps for name in names},
            "seconds": {name: round(self.seconds.get(name, 0.0), 1) for name in names},
            "device": _named(self.corpus.device),
            **self.system.summary(),
            "validation": last,
            "versions": {"lads-exporter": __version__, "torch": torch.__version__},
        }
        write_atomically(self.out / SUMMARY, (json.dumps(summary, indent=1) + "\n").encode())


def _named(device):
    """Names a device as its maker does where that says something about the time that a training took."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


class SharedEncoder:
    """The file of an encoder of frames that several systems observe by: weights, and what they were made of."""

    def __init__(self, path, trainer):
        self.path, self.trainer = Path(path), trainer
        if trainer.system.stages(trainer.config)[0] != FRAMES:
            raise UserError(f"--encoder {path}: {trainer.config.name} has no encoder of frames that learns in a stage of its own (images.frames.steps)")
        config, identity = trainer.setting.tables[0], trainer.identity
        parts = [config["images"], config["data"], identity["dataset_sha256"], identity["rendering"], trainer.seed]
        self.made_of = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def read(self):
        """Takes the encoder from the file; false where there is none yet."""
        if not self.path.exists():
            return False
        try:
            saved = torch.load(self.path, map_location=self.trainer.corpus.device, weights_only=True)
            made_of, frames, state, seconds = (saved[key] for key in ("made_of", "frames", "state", "seconds"))
            seconds = float(seconds)
        except UNREADABLE as error:
            raise UserError(f"{self.path}: no encoder of frames ({type(error).__name__}); it stays as it is: move it away to train one") from error
        if made_of != self.made_of:
            raise UserError(f"{self.path}: its encoder was made with another configuration, dataset or seed; name another file")
        load_networks(self.trainer.networks.frames, frames, self.path)
        load_networks(self.trainer.networks.state, state, self.path)
        self.trainer.seconds[FRAMES] = seconds
        return True

    def write(self):
        networks = self.trainer.networks
        buffer = io.BytesIO()
        parts = {"frames": networks.frames.state_dict(), "state": networks.state.state_dict(), "seconds": self.trainer.seconds[FRAMES]}
        torch.save({"made_of": self.made_of} | parts, buffer)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path, buffer.getvalue())


def golden_candidates(dataset, episodes, setting, most=24):
    """Lists held-out episodes one of which will be the bundle's golden episode: (instruction index, observations [T, O]), or {channel: [T, ...]}
    in place of the observations where there are several."""
    if dataset.features is not None:
        seen, drawn = setting.config.pretrained, dataset.features.frames
        frames = lambda rows: torch.from_numpy(np.stack([drawn[row] for row in range(rows.start, rows.stop)]))
        joints = lambda rows: torch.from_numpy(dataset.observations[rows, : seen.joints].copy())
        chosen = golden_episodes(dataset, setting)
        return [(int(dataset.instruction[e]), {seen.channel: frames(rows), OBSERVATION: joints(rows)}) for e, rows in chosen]
    index = dataset.instruction
    if dataset.texts is not None:  # those whose label is an instruction of the bundle
        known = [row["text"] for row in setting.instructions]
        index = np.array([known.index(text) if text in known else -1 for text in dataset.texts])[dataset.instruction]
        episodes = [episode for episode in episodes if index[episode] >= 0]
    chosen = episodes[:: max(1, len(episodes) // most)][:most]
    seen = lambda rows: dataset.observations[rows].copy() if dataset.frames is None else dataset.frames[dataset.frame_rows[rows]]
    return [(int(index[e]), torch.from_numpy(seen(dataset.rows(e)))) for e in chosen]


def _short(validation):
    return {name: f"{value:.3g}" for name, value in validation.items()}


def _read(path, device="cpu"):
    """Reads a checkpoint's contents."""
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
    except UNREADABLE as error:
        raise UserError(f"{path}: half written or damaged ({type(error).__name__}); it stays as it is: move its folder away and train anew") from error
    try:
        saved["networks"], saved["identity"]["tables"], saved["position"]["stage"]
    except (KeyError, TypeError, IndexError) as error:
        raise UserError(f"{path} is damaged, or was made by an earlier version of this exporter ({error!r}); train it again") from error
    return saved


def load_networks(networks, state, path):
    """Loads weights, which must be those of these networks and finite."""
    try:
        networks.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: its weights are not those of its configuration ({str(error).splitlines()[0]}); it is damaged: train it again") from error
    if not all(bool(torch.isfinite(value).all()) for value in networks.state_dict().values() if value.is_floating_point()):
        raise UserError(f"{path}: a weight is not a finite number; it is damaged: train it again")


def load_run(folder, *over):
    """Loads a finished run's checkpoint and its setting; `over` are files of a system's values to export it with."""
    path = Path(folder) / CHECKPOINT
    if not path.is_file():
        raise UserError(f"no run in {folder}: {path} does not exist; train one first (make train)")
    saved = _read(path)
    table, *beside = saved["identity"]["tables"]
    for one in over:
        table = configuration.exported_with(table, one)
    setting = configuration.from_tables(table, *beside, path)
    setting = dataclasses.replace(setting, rendering=saved["identity"].get("rendering"))
    names = systems.of(setting.config).Training.stages(setting.config)
    if saved["position"]["stage"] < len(names):
        raise UserError(f"{folder} is not finished (stage {names[saved['position']['stage']]}); continue it with --resume")
    return saved, setting
