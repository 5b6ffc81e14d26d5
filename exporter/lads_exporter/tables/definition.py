"""Reads a table's file: what is measured, how, in which tracks, and by which systems.

Everything in it is checked before anything runs: unknown keys, systems and configurations are named, all at once.
"""

import dataclasses
import math
import re
import os
from dataclasses import dataclass
from pathlib import Path

from .. import config
from ..config import UserError

MEASURES = ("success", "n_rate")
NOISE = ("v0", "v1", "none")


@dataclass(frozen=True, eq=False)
class Evaluation:
    episodes: int  # of each instruction
    seed: int
    noise: str


@dataclass(frozen=True, eq=False)
class Track:
    name: str
    config: str  # the base configuration of all its systems
    note: str
    seeds: list  # of the training, of systems that say nothing else


@dataclass(frozen=True, eq=False)
class System:
    id: str
    title: str
    config: str  # values over the track's base configuration
    published: dict  # split -> [mean, deviation], [mean] or []
    tracks: list = dataclasses.field(default_factory=list)  # none: all
    weights: str = ""  # trains nothing: takes the run of this system, and exports it with its own configuration
    seeds: dict = dataclasses.field(default_factory=dict)  # track -> seeds of its own
    sweep: dict = dataclasses.field(default_factory=dict)  # what a figure of several sizes varies -> its value here

    @property
    def trained(self):
        """Returns the id of the system whose training run this system is exported from."""
        return self.weights or self.id


@dataclass(frozen=True, eq=False)
class Table:
    name: str
    title: str
    measure: str  # "success" of the whole instruction, in per cent, or "n_rate"
    data: str
    splits: list  # names of lads-run's splits
    headings: list  # what the table calls them
    evaluation: Evaluation
    tracks: list
    systems: list
    folder: Path  # where the file lies; paths in it are relative to it
    frames: str = ""  # of the dataset's states, for systems that observe by a camera
    features: str = ""  # of those frames instead, for systems with a frozen encoder

    def path(self, name):
        """Returns a whole path, which means the same in every folder that a command runs in."""
        return Path(os.path.normpath(self.folder / name))

    def system(self, id):
        return next(row for row in self.systems if row.id == id)

    def rows(self, track):
        """Returns the systems of a track."""
        return [row for row in self.systems if not row.tracks or track.name in row.tracks]

    def seeds(self, system, track):
        return system.seeds.get(track.name, track.seeds)

    def configuration(self, track, system):
        """Lists the files of a system's configuration in a track: base, then the system's."""
        return [self.path(track.config), self.path(system.config)]


def _row(kind, table, where):
    """Makes a dataclass from a TOML table; fields with a default may be left out."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    problems = [f"unknown key {key!r}" for key in table if key not in fields]
    for name, field in fields.items():
        if name not in table:
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                problems.append(f"key {name!r} is missing")
        elif not isinstance(table[name], field.type):
            problems.append(f"{name} must be {field.type.__name__}, not {table[name]!r}")
    if problems:
        raise UserError(f"{where}: {'; '.join(problems)}")
    return kind(**table)


def load(path):
    """Reads and checks a table and every configuration that it names."""
    path = config.find(path)
    table = dict(config.read_toml(path))
    parts = {"evaluation": Evaluation, "track": Track, "system": System}
    missing = [heading for key, heading in (("evaluation", "[evaluation]"), ("track", "[[track]]"), ("system", "[[system]]")) if key not in table]
    unknown = [key for key in ("tracks", "systems", "folder") if key in table]
    if missing or unknown:
        raise UserError(f"{path}: " + "; ".join([*(f"{heading} is missing" for heading in missing), *(f"unknown key {key!r}" for key in unknown)]))
    for key in ("track", "system"):
        if not isinstance(table[key], list) or not all(isinstance(row, dict) for row in table[key]):
            raise UserError(f"{path}: {key}s are a list of tables, [[{key}]]")
    table["evaluation"] = _row(Evaluation, table["evaluation"], f"{path}[evaluation]")
    for key, many in (("track", "tracks"), ("system", "systems")):
        table[many] = [_row(parts[key], row, f"{path}[[{key}]] {row.get('id', row.get('name', ''))}") for row in table.pop(key)]
    found = _row(Table, table | {"folder": path.parent.resolve()}, path)
    _check(found, path)
    return found


def _check(table, path):
    problems = []
    if table.measure not in MEASURES:
        problems.append(f"measure = {table.measure!r}: must be one of {', '.join(MEASURES)}")
    if table.frames and table.features:
        problems.append("frames and features exclude each other")
    if len(table.splits) != len(table.headings):
        problems.append("splits and headings must be as many")
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", table.name):
        problems.append(f"name = {table.name!r}: must be letters, digits, _ and -, for it names a folder")
    asked = table.evaluation
    if type(asked.episodes) is not int or asked.episodes < 1:
        problems.append(f"evaluation.episodes = {asked.episodes}: must be at least 1")
    if type(asked.seed) is not int or asked.seed < 0:
        problems.append(f"evaluation.seed = {asked.seed}: must be a whole number from 0 on")
    if asked.noise not in NOISE:
        problems.append(f"evaluation.noise = {asked.noise!r}: must be one of {', '.join(NOISE)}")
    for what, names in (("split", table.splits), ("track", [row.name for row in table.tracks])):
        problems += [f"{what} {name!r} stands twice" for name in {name for name in names if names.count(name) > 1}]
    for row in (*table.tracks, *table.systems):
        lists = [row.seeds] if isinstance(row, Track) else row.seeds.values()
        if not all(isinstance(seeds, list) and seeds and all(type(seed) is int and seed >= 0 for seed in seeds) and len(set(seeds)) == len(seeds) for seeds in lists):
            problems.append(f"seeds of {getattr(row, 'id', None) or row.name!r}: must be lists of different whole numbers from 0 on")
    ids, tracks = [row.id for row in table.systems], [row.name for row in table.tracks]
    problems += [f"system {id!r} stands twice" for id in {id for id in ids if ids.count(id) > 1}]
    for row in table.systems:
        problems += [f"system {row.id!r}: unknown track {name!r}; known: {', '.join(tracks)}" for name in [*row.tracks, *row.seeds] if name not in tracks]
        problems += [f"system {row.id!r}: the paper has no split {name!r}" for name in row.published if name not in table.splits]
        number = lambda value: type(value) in (int, float) and math.isfinite(value)
        if not all(number(value) for value in row.sweep.values()):
            problems.append(f"system {row.id!r}: sweep = {row.sweep!r}: must be numbers by name")
        if not all(isinstance(values, list) and len(values) <= 2 and all(map(number, values)) for values in row.published.values()):
            problems.append(f"system {row.id!r}: published = {row.published!r}: must be [mean, deviation], [mean] or [] by split")
        if row.weights and row.weights not in ids:
            problems.append(f"system {row.id!r}: weights = {row.weights!r}: unknown system; known: {', '.join(ids)}")
    for track in table.tracks:
        for row in table.rows(track):
            try:
                config.load(*table.configuration(track, row))
            except UserError as error:
                problems.append(f"system {row.id!r} in track {track.name!r}: {error}")
    if problems:
        raise UserError(f"{path}: " + "\n  ".join(problems))
