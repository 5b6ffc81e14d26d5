"""Runs a job, one system and one seed in one track: train, export, evaluate, each by the command that a person would type.

A job's folder carries the hash of all that its weights depend on (configuration, dataset, language encoder, seed) and its bundle's name that of
what an export adds, so other inputs mean other files, and nothing is overwritten. What is finished is kept; an interrupted training goes on. What can
fail: a command ends with an error, which is the job's; a checkpoint or a results file that is there is damaged or of another protocol, and is named.
"""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from .. import card, config, language
from ..config import UserError
from ..training import CHECKPOINT, CURVES, SUMMARY
from .commands import Command, Rollouts
from .render import check_scores

SUMMARISED = ("perplexity", "codebook_size", "plan_elements_in_use", "validation", "steps", "device")  # of a training's summary, in the table's file
SCORES = ("episodes", "n_rate", "n_rate_standard_error", "k_rate", "full_success", "full_success_count")  # of a split's results, in the same


@dataclass(frozen=True, eq=False)
class Place:
    """Folders where a table's jobs find and leave things."""

    runs: Path
    data: Path
    data_sha256: str
    lads_run: Path
    frames: Path | None = None  # of the dataset's states
    features: Path | None = None  # of those frames instead, made by a frozen encoder
    seen: object = None  # of frames how they were drawn, of features that and the encoder's hash; their last bits depend on the machine that drew them
    threads: int = 1  # of a training: sums depend on their number
    device: str = "cpu"  # that trainings run on

    @property
    def large(self):
        """Returns the files that are too large to go along with every command."""
        return [path for path in (self.data, self.frames, self.features) if path]


@dataclass(frozen=True, eq=False)
class Job:
    table: object
    track: object
    system: object
    seed: int
    place: Place

    @property
    def label(self):
        return f"{self.track.name} {self.system.title} seed {self.seed}"

    @property
    def trained(self):
        """Returns the system whose run this is."""
        return self.table.system(self.system.trained)

    @property
    def folder(self):
        return self.place.runs / self.table.name / self.track.name / f"{self.trained.id}-seed{self.seed}-{self.inputs[:12]}"

    @cached_property
    def _setting(self):
        return config.load(*self.table.configuration(self.track, self.trained))

    @property
    def environment(self):
        """Returns the id of the environment that the job's episodes run in."""
        return self._setting.environment["id"]

    @property
    def _encoder(self):
        return self._setting.config.language.encoder

    @cached_property
    def inputs(self):
        """Hashes all that the trained weights depend on."""
        tables = json.loads(json.dumps(self._setting.tables))
        own = tables[0].get("system", {})
        tables[0]["system"] = {key: value for key, value in own.items() if key not in config.ACTING}
        encoder = self._encoder
        known = encoder if encoder.startswith("random-") else language.weights_sha256(encoder)
        seen = [self.place.seen] if self.place.seen else []
        return _hash([tables, self.place.data_sha256, known, self.seed, self.place.threads, *seen])

    @property
    def shared_encoder(self):
        """Returns the file of the encoder of frames, which a track's systems share; None where there is none."""
        table = self._setting.tables[0]
        if not self._setting.config.images.frames.steps:
            return None
        made_of = _hash([table["images"], table["data"], self.place.data_sha256, self.place.seen, self.seed, self.place.threads])
        return self.place.runs / self.table.name / self.track.name / f"encoder-seed{self.seed}-{made_of[:12]}.pt"

    @cached_property
    def exported(self):
        """Hashes all that the bundle depends on."""
        own = config.load(*self.table.configuration(self.track, self.system)).tables[0].get("system", {})
        return _hash([self.inputs, own])

    @property
    def identity(self):
        """Hashes all that the job's numbers depend on."""
        return _hash([self.exported, dataclasses.asdict(self.table.evaluation)])

    @property
    def bundle(self):
        return self.folder / f"{self.system.id}-{self.exported[:12]}.onnx"

    @property
    def results(self):
        return self.bundle.with_suffix(".results.json")

    @property
    def finished(self):
        return self.results.is_file() and self.bundle.is_file()

    def run(self, engine):
        """Runs the steps of the job that are not done yet."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self.folder / SUMMARY).is_file():
            engine.run(self._training())
        if not self.bundle.is_file():
            engine.run(self._export())
        if not self.results.is_file():
            engine.evaluate(self.rollouts(self.results))
        self.numbers()

    @property
    def log(self):
        return self.folder / "log.txt"

    def _training(self):
        place, (base, over) = self.place, self.table.configuration(self.track, self.trained)
        written = [self.folder / name for name in (CHECKPOINT, CURVES, SUMMARY)]
        resume = ["--resume"] if written[0].is_file() else []
        options = ["--config", base, "--system", over, "--data", place.data, "--out", self.folder, "--seed", self.seed, "--threads", place.threads]
        options += ["--device", place.device] if place.device != "cpu" else []
        for name, path in (("--frames", place.frames), ("--features", place.features)):
            options += [name, path] if path else []
        if self.shared_encoder:
            options += ["--encoder", self.shared_encoder]
            written.insert(0, self.shared_encoder)
        there = [path for path in written if path.is_file()]
        return Command(None, ["train", *options, *resume], [*config.files(base, over), *place.large, *there], written, self.log, self._encoder)

    def _export(self):
        own = self.table.path(self.system.config)
        run = [self.folder / name for name in (CHECKPOINT, CURVES, SUMMARY)]
        arguments = ["export", "--run", self.folder, "--system", own, "-o", self.bundle]
        return Command(None, arguments, [own, *run], [self.bundle.with_suffix(".md"), self.bundle], self.log, self._encoder)

    def rollouts(self, results, uniform=False):
        """Returns the episodes that the table asks for, of this job's bundle."""
        instructions = [row["id"] for row in self._setting.instructions]
        log = results.with_name("uniform.log.txt") if uniform else self.log
        return Rollouts(self.table.evaluation, instructions, self.bundle, results, self.place.lads_run, log, uniform)

    def numbers(self):
        """Returns what the table keeps of a finished job: its bundle's hash, training time and summary, and the scores of its splits."""
        sha256 = hashlib.sha256(self.bundle.read_bytes()).hexdigest()
        splits = checked_results(self.table, self.results, sha256)
        try:
            summary = json.loads((self.folder / SUMMARY).read_text())
            seconds = sum(summary["seconds"].values())
            kept = {key: summary.get(key) for key in SUMMARISED}
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{self.folder / SUMMARY}: not a training's summary ({error!r}); move the folder away to train anew") from error
        return {"bundle_sha256": sha256, "training_s": seconds, "summary": kept, "splits": splits}


def _hash(parts):
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def checked_results(table, path, sha256=None):
    """Reads the scores of a table's splits; refuses results that are not of the table's protocol or not of the bundle, with what differs."""
    found = card.read_results(path)
    asked = table.evaluation
    pairs = [("seed", found.get("seed"), asked.seed), ("noise", found.get("noise"), asked.noise)]
    pairs.append(("episodes_per_instruction", found.get("episodes_per_instruction"), asked.episodes))
    if sha256:
        pairs.append(("bundle_sha256", found.get("bundle_sha256"), sha256))
    pairs += [(f"split {name}", "absent", "present") for name in table.splits if name not in found["splits"]]
    pairs += [(f"{key} of split {name}", "absent", "present") for name in table.splits for key in SCORES if key not in found["splits"].get(name, SCORES)]
    wrong = [f"{name} is {got}, not {wanted}" for name, got, wanted in pairs if got != wanted]
    if wrong:
        raise UserError(f"{path}: of another protocol ({'; '.join(wrong)}); it stays as it is: move it away, and the same command measures anew")
    scores = {name: {key: found["splits"][name][key] for key in SCORES} for name in table.splits}
    try:
        check_scores(scores, path)
    except (ValueError, TypeError) as error:
        raise UserError(f"{error}; move the file away, and the same command measures anew") from error
    return scores


def all_jobs(table, place):
    """Lists all jobs track by track, seed by seed; those that export another's run come after it."""
    return [
        Job(table, track, system, seed, place)
        for track in table.tracks
        for system in sorted(table.rows(track), key=lambda row: bool(row.weights))
        for seed in table.seeds(system, track)
    ]

