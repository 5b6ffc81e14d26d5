"""Training LADS: jointly by Algorithm 1, or in three stages.

The stop-gradients of equation 7 keep the cross-entropy from moving the plans and the other losses from
moving the high level, so the stages minimise the same sum (equation 11) in turn:
1. `plans`: encoder, codebook, low level and semantic regularisation;
2. `low_level`: the low level alone, on the frozen codes of all windows;
3. `high_level`: the transformer alone, on the frozen codes of all windows.

Every step seeds the random numbers with (seed, stage, step): a resumed run does what an uninterrupted one
would have done. An interrupt finishes the step at hand, writes a checkpoint and stops.
"""

import csv
import io
import json
import math
import signal
import time
import zlib
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from tqdm import tqdm

from . import __version__, config as configuration, language
from .output import write_atomically
from .codebook import nearest, perplexity
from .config import UserError
from .corpus import Corpus
from .endings import Endings
from .hindsight import relabel
from .model import Lads

STAGES = {"joint": ("joint",), "staged": ("plans", "low_level", "high_level")}
LOG_EVERY, VALIDATE_EVERY, SAVE_SECONDS = 50, 500, 120
CHECKPOINT, CURVES, SUMMARY = "checkpoint.pt", "curves.csv", "summary.json"
COLUMNS = ("stage", "step", "learning_rate", "ms_per_step", "loss", "bc", "commitment", "align", "ce", "perplexity",
           "revived", "val_bc", "val_perplexity", "val_ce", "val_accuracy")  # fmt: skip


class Losses:
    """The losses of Section 4 on a corpus, as functions of episodes."""

    def __init__(self, lads, corpus, setting):
        self.lads, self.corpus, self.config = lads, corpus, setting.config
        self.endings = Endings(setting, corpus.device)
        self.autocast = setting.config.training.bf16 and _fast_bfloat16(corpus.device)

    def offsets(self, episodes, generator):
        if not self.config.training.random_offset:
            return torch.zeros(len(episodes), dtype=torch.long)
        return torch.randint(self.corpus.horizon, (len(episodes),), generator=generator)

    def plans(self, episodes, offsets):
        """L_BC, the commitment term of L_VQ and L_align (equations 5, 6, 10); and the segments' codes [B, T].

        The code of a segment stands at the step at which it starts, -1 at all other steps.
        """
        lads, segments = self.lads, self.corpus.segments(episodes, offsets)
        latents = lads.encoder(segments.observations, segments.executed, segments.lengths)
        plans, index, commitment = lads.codebook(latents)
        valid = segments.valid
        each = plans[:, None].expand(-1, self.corpus.horizon, -1)[valid]
        actions = lads.low_level(segments.low_level_observations[valid], each)
        losses = {"bc": F.mse_loss(actions, segments.actions[valid]), "commitment": commitment}
        losses["align"] = self._align(plans, segments, episodes)
        codes = torch.full((len(episodes), self.corpus.steps), -1, dtype=torch.long, device=self.corpus.device)
        codes[segments.rows, segments.starts] = index
        return losses, codes

    def _align(self, plans, segments, episodes):
        if self.config.alignment.weight == 0:
            return plans.new_zeros(())
        most = int(segments.places.max()) + 1
        sequence = plans.new_zeros(len(episodes), most, plans.shape[1])
        valid = torch.zeros(len(episodes), most, dtype=torch.bool, device=plans.device)
        sequence[segments.rows, segments.places] = plans
        valid[segments.rows, segments.places] = True
        instruction = self.corpus.instruction[episodes].to(plans.device)
        return self.lads.alignment(sequence, valid, self.corpus.sentences[instruction], instruction)

    def high_level(self, episodes, codes):
        """L_CE (equation 8) and the accuracy; codes [B, T] are the targets, -1 where there is none."""
        corpus = self.corpus
        length = int(corpus.lengths[episodes].max())
        at = episodes.to(corpus.device)
        words, codes = self._instructions(episodes, codes[:, :length])
        observations, executed = corpus.observations[at, :length], corpus.executed[at, :length]
        words, codes, observations, executed = self._contexts(words, codes, observations, executed)
        with torch.autocast(corpus.device.type, torch.bfloat16, enabled=self.autocast):
            logits = self.lads.high_level(words, observations, executed)
        logits, targets = logits[codes >= 0], codes[codes >= 0]
        return F.cross_entropy(logits, targets), (logits.argmax(-1) == targets).float().mean()

    def _contexts(self, words, codes, observations, executed):
        """Cuts trajectories that are longer than the context where the controller restarts it: a row for each context."""
        most, length = self.config.high_level.context_steps, codes.shape[1]
        if length <= most:
            return words, codes, observations, executed
        count = -(-length // most)
        more = count * most - length
        codes = F.pad(codes, (0, more), value=-1).reshape(-1, most)
        observations, executed = (F.pad(x, (0, 0, 0, more)).reshape(-1, most, x.shape[-1]) for x in (observations, executed))
        kept = (codes >= 0).any(1)
        words = [words[row // count] for row in kept.nonzero()[:, 0].tolist()]
        return words, codes[kept], observations[kept], executed[kept]

    def _instructions(self, episodes, codes):
        """The words of each episode's instruction and its targets; in training, some with another ending."""
        words = [self.corpus.words[i] for i in self.corpus.instruction[episodes]]
        if not self.lads.high_level.training:
            return words, codes
        if self.corpus.own_texts:  # labels of what was done have no order, so no ending
            return [self._some_words(row) for row in words], codes
        codes = codes.clone()
        for row, episode in enumerate(episodes.tolist()):
            other = self.endings.draw(int(self.corpus.instruction[episode]), int(self.corpus.lengths[episode]))
            if other is not None:
                words[row], steps = other
                codes[row, steps:] = -1
        return [self._some_words(row) for row in words], codes

    def _some_words(self, words):
        """The words, disturbed, less a random few; the last token ([SEP]) always stays."""
        rate, noise = self.config.data.word_dropout, self.config.data.word_noise
        if noise > 0:
            words = words + noise * words.square().mean().sqrt() * torch.randn_like(words)
        if rate == 0:
            return words
        keep = torch.rand(len(words), device=words.device) >= rate
        keep[-1] = True
        return words[keep]

    @torch.no_grad()
    def encode(self, segments):
        latents = self.lads.encoder(segments.observations, segments.executed, segments.lengths)
        return nearest(latents, self.lads.codebook.codes)


def _fast_bfloat16(device):
    return device.type == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


@contextmanager
def _matmul_precision(name):
    """"medium" lets matrix products round their inputs to bfloat16 where that is faster; sums stay in float32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class Stage:
    """One stage: its parameters, and the total loss of one step."""

    def __init__(self, name, trainer):
        self.name, self.trainer = name, trainer
        self.lads, self.corpus, self.losses = trainer.lads, trainer.corpus, trainer.losses
        self.training = trainer.config.training
        self.settings = getattr(self.training, name)
        parts = {
            "joint": ("encoder", "low_level", "alignment", "high_level"),
            "plans": ("encoder", "low_level", "alignment"),
            "low_level": ("low_level",),
            "high_level": ("high_level",),
        }[name]
        self.modules = [getattr(self.lads, part) for part in parts]
        if name in ("joint", "plans"):
            self.modules.append(self.lads.codebook)
        self.parameters = [value for part in parts for value in getattr(self.lads, part).parameters()]
        rate, decay = self.settings.learning_rate, self.settings.weight_decay
        self.optimizer = torch.optim.AdamW(self.parameters, rate, weight_decay=decay, fused=True)
        self.codes = None
        if name in ("low_level", "high_level"):
            self.lads.eval()
            self.codes = self.corpus.codes(self.losses.encode, range(len(self.corpus.lengths)))
        if name == "high_level" and self.training.ce_at == "decisions":
            self.codes[:, torch.arange(self.corpus.steps) % self.corpus.horizon > 0] = -1
        if name == "low_level":
            self._list_transitions()

    def _list_transitions(self):
        corpus = self.corpus
        lengths = corpus.lengths[corpus.train]
        self.episodes = corpus.train.repeat_interleave(lengths)
        self.steps = torch.cat([torch.arange(n) for n in lengths.tolist()])
        self.cumulative = corpus.weights[self.episodes].double().cumsum(0)

    def learning_rate(self, step):
        """Linear warm-up, then a cosine down to `final` of the rate."""
        s = self.settings
        cosine = 0.5 * (1 + math.cos(math.pi * step / s.steps))
        return s.learning_rate * min(1.0, (step + 1) / s.warmup) * (s.final + (1 - s.final) * cosine)

    def loss(self, step):
        """The total loss of a step and its parts."""
        generator_of = lambda draw: torch.Generator().manual_seed(self.trainer.seed_of(self.name, "draw", draw))
        if self.name == "low_level":
            return self._low_level_loss(generator_of(step))
        if self.name == "high_level":
            episodes = self.corpus.draw_alike(self.settings.batch, step, generator_of)
            ce, _ = self.losses.high_level(episodes, self.codes[episodes.to(self.corpus.device)])
            return ce, {"ce": ce}
        return self._plans_loss(step, generator_of(step))

    def _low_level_loss(self, generator):
        corpus, batch = self.corpus, self.settings.batch
        points = torch.rand(batch, generator=generator, dtype=torch.double) * self.cumulative[-1]
        drawn = torch.searchsorted(self.cumulative, points).clamp(max=len(self.steps) - 1)
        episodes, steps = self.episodes[drawn], self.steps[drawn]
        starts = (steps - torch.randint(corpus.horizon, (batch,), generator=generator)).clamp(min=0)
        episodes, steps, starts = (x.to(corpus.device) for x in (episodes, steps, starts))
        plans = self.lads.codebook.codes[self.codes[episodes, starts]]
        bc = F.mse_loss(self.lads.low_level(corpus.shown(episodes, steps), plans), corpus.actions[episodes, steps])
        return self.training.bc_weight * bc, {"bc": bc}

    def _plans_loss(self, step, generator):
        if step == self.trainer.config.encoder.kmeans_step:
            self._start_codebook(generator)
        episodes = self.corpus.draw(self.settings.batch, generator)
        offsets = self.losses.offsets(episodes, generator)
        parts, codes = self.losses.plans(episodes, offsets)
        total = self.training.bc_weight * parts["bc"] + parts["commitment"]
        total = total + self.trainer.config.alignment.weight * parts["align"]
        if self.lads.codebook.started:
            parts["perplexity"] = perplexity(codes[codes >= 0], len(self.lads.codebook.codes))
            if self.name == "joint":
                if self.training.ce_at == "all":
                    codes = self.corpus.codes(self.losses.encode, episodes.tolist())
                parts["ce"], _ = self.losses.high_level(episodes, codes)
                total = total + parts["ce"]
        return total, parts

    @torch.no_grad()
    def _start_codebook(self, generator):
        latents = []
        for episodes in self.corpus.train.split(64):
            segments = self.corpus.segments(episodes, self.losses.offsets(episodes, generator))
            latents.append(self.lads.encoder(segments.observations, segments.executed, segments.lengths))
        self.lads.codebook.start(torch.cat(latents))

    @torch.no_grad()
    def finish(self):
        """After the stage that trains it, a policy's correction goes into its last layer.

        High level: less what is frequent anyway, the logits say which plan the instruction speaks for. Low level: the mean of
        random actions is small even where their direction is clear, and a policy that follows it is slow, so it has a gain.
        """
        if self.name in ("joint", "high_level"):
            uses = self.lads.codebook.uses
            self.lads.high_level.head.bias.sub_(self.trainer.config.high_level.balance * (uses / uses.sum()).log())
        if self.name in ("joint", "low_level"):
            gain = self.trainer.config.low_level.gain
            self.lads.low_level.last.weight.mul_(gain)
            self.lads.low_level.last.bias.mul_(gain)

    @torch.no_grad()
    def validate(self):
        """Losses on the held-out episodes, segmented from step 0."""
        episodes = self.corpus.validation
        self.lads.eval()
        parts, codes = self.losses.plans(episodes, torch.zeros(len(episodes), dtype=torch.long))
        out = {"val_bc": float(parts["bc"])}
        if self.lads.codebook.started:
            out["val_perplexity"] = perplexity(codes[codes >= 0], len(self.lads.codebook.codes))
            if self.name in ("joint", "high_level"):
                ce, accuracy = self.losses.high_level(episodes, codes)
                out |= {"val_ce": float(ce), "val_accuracy": float(accuracy)}
        return out

    def advance(self, step):
        """One optimiser step; returns the parts of the loss as numbers."""
        torch.manual_seed(self.trainer.seed_of(self.name, "step", step))
        self.lads.eval()
        for module in self.modules:
            module.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(step)
        total, parts = self.loss(step)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.training.clip)
        self.optimizer.step()
        numbers = {name: float(torch.as_tensor(value).detach()) for name, value in (parts | {"loss": total}).items()}
        if not math.isfinite(numbers["loss"]):
            raise UserError(f"the loss is no longer finite at step {step} of stage {self.name}; lower its learning_rate")
        return numbers


class Trainer:
    """A run: a folder with a checkpoint, the curves and at the end a summary."""

    def __init__(self, setting, dataset, encoded, out, device, seed):
        self.setting, self.config, self.out, self.seed = setting, setting.config, Path(out), seed
        self.identity = {
            "tables": setting.tables,
            "dataset_sha256": dataset.sha256,
            "language_sha256": encoded.sha256,
            "seed": seed,
        }
        torch.manual_seed(self.seed_of("", "weights", 0))
        self.lads = Lads(setting, encoded).to(device)
        data = self.config.data
        if data.hindsight > 0:
            dataset = relabel(dataset, setting, data.hindsight, data.hindsight_latest, data.hindsight_most, self.seed_of("", "hindsight", 0))
        own = encoded if dataset.texts is None else language.encode(self.config.language, dataset.texts)
        self.corpus = Corpus(dataset, setting, own, device)
        self.lads.normalizer.mean.copy_(self.corpus.mean)
        self.lads.normalizer.std.copy_(self.corpus.std)
        self.losses = Losses(self.lads, self.corpus, setting)
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
        saved = torch.load(path, map_location=self.corpus.device, weights_only=True)
        for key, value in self.identity.items():
            if saved["identity"][key] != value:
                raise UserError(f"{path} was made with another {key.removesuffix('_sha256')}; train into a new folder")
        self.lads.load_state_dict(saved["lads"])
        self.position, self.curves, self.seconds = saved["position"], saved["curves"], saved["seconds"]
        return saved["optimizer"]

    def save(self, stage):
        state = {
            "identity": self.identity,
            "position": self.position,
            "lads": self.lads.state_dict(),
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

    def run(self, resume=False, quiet=False):
        """Trains to the end; False when it was interrupted (the checkpoint is then written)."""
        if not resume and (self.out / CHECKPOINT).exists():
            raise UserError(f"{self.out / CHECKPOINT} exists; continue it with --resume or choose another --out")
        optimizer_state = self.resume() if resume else None
        names = STAGES[self.config.training.schedule]
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
        self._summarise(names)
        return True

    def _run_stage(self, stage, quiet):
        steps, begun, saved = stage.settings.steps, time.monotonic(), time.monotonic()
        spent = self.seconds.get(stage.name, 0.0)
        sums, latest, counted_from = defaultdict(list), {}, time.monotonic()
        bar = tqdm(total=steps, initial=self.position["step"], desc=stage.name, disable=quiet, unit="step")
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
                    row["revived"] = int(self.lads.codebook.revived)
                    self.curves.append(row)
                    shown = ("loss", "bc", "align", "ce", "perplexity")
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
        self.lads.eval()
        codes = self.corpus.codes(self.losses.encode, range(len(self.corpus.lengths)))
        starts = codes[:, :: self.corpus.horizon]
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
            "steps": {name: getattr(self.config.training, name).steps for name in names},
            "seconds": {name: round(self.seconds.get(name, 0.0), 1) for name in names},
            "perplexity": perplexity(starts[starts >= 0], len(self.lads.codebook.codes)),
            "codebook_size": len(self.lads.codebook.codes),
            "revived": int(self.lads.codebook.revived),
            "validation": last,
            "versions": {"lads-exporter": __version__, "torch": torch.__version__},
        }
        write_atomically(self.out / SUMMARY, (json.dumps(summary, indent=1) + "\n").encode())


def golden_candidates(dataset, episodes, setting, most=24):
    """Held-out episodes one of which will be the bundle's golden episode: (instruction index, observations [T, O])."""
    index = dataset.instruction
    if dataset.texts is not None:  # those whose label is an instruction of the bundle
        known = [row["text"] for row in setting.instructions]
        index = np.array([known.index(text) if text in known else -1 for text in dataset.texts])[dataset.instruction]
        episodes = [episode for episode in episodes if index[episode] >= 0]
    chosen = episodes[:: max(1, len(episodes) // most)][:most]
    return [(int(index[e]), torch.from_numpy(dataset.observations[dataset.rows(e)].copy())) for e in chosen]


def _short(validation):
    return {name: f"{value:.3g}" for name, value in validation.items()}


def load_run(folder):
    """A finished or interrupted run's checkpoint and its setting."""
    path = Path(folder) / CHECKPOINT
    if not path.is_file():
        raise UserError(f"no run in {folder}: {path} does not exist; train one first (make train)")
    saved = torch.load(path, map_location="cpu", weights_only=True)
    setting = configuration.from_tables(*saved["identity"]["tables"], path)
    names = STAGES[setting.config.training.schedule]
    if saved["position"]["stage"] < len(names):
        raise UserError(f"{folder} is not finished (stage {names[saved['position']['stage']]}); continue it with --resume")
    return saved, setting
