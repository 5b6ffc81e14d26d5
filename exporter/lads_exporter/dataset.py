"""Reads demonstrations from a file: the project's safetensors layout, or D4RL's kitchen HDF5.

A `Dataset` holds whole episodes of seen instructions only; an episode labelled with an unseen
instruction is refused (safetensors) or left out and counted (D4RL), so the split stays what it says.
"""

import hashlib
import json
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from . import frames as frame_file
from .config import UserError

FORMAT, VERSION = "lads-dataset", "1"
_WIDTHS = {"observations": "O", "actions": "A", "executed": "A", "states": "O"}


@dataclass(frozen=True)
class Dataset:
    """Demonstrations as rows of all episodes one after the other; episode e is rows offsets[e] to offsets[e + 1]."""

    observations: np.ndarray  # [T, O] as the policy sees them
    states: np.ndarray | None  # [T, O] without observation noise, where the file has them
    actions: np.ndarray  # [T, A] the label
    executed: np.ndarray  # [T, A] what was applied
    offsets: np.ndarray  # [E + 1]
    instruction: np.ndarray  # [E], index into the setting's instructions
    sha256: str
    notes: dict = field(default_factory=dict)  # counts for the model card
    frames: np.ndarray | None = None  # [T', r, c, 3] what a camera sees, where the setting has one
    frame_rows: np.ndarray | None = None  # [T] the row of `frames` for each step
    rendering: dict | None = None  # how they were drawn
    features: object | None = None  # `features.Features`: what a frozen encoder made of them, in place of `frames`
    texts: list | None = None  # the file's own instructions, where it has others than the setting; `instruction` points here

    def __len__(self):
        return len(self.instruction)

    def lengths(self):
        return np.diff(self.offsets)

    def rows(self, episode):
        return slice(int(self.offsets[episode]), int(self.offsets[episode + 1]))

    def noise_amplitude(self):
        """Half-width [O] of the uniform observation noise: the largest seen."""
        return np.abs(self.observations - self.states).max(0)


def load(path, setting, frames=None):
    """Reads a dataset for a setting, with the file of its frames where the setting has a camera; the suffix .hdf5 or .h5 means D4RL."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"no dataset at {path}; collect one first (make collect)")
    read = _read_d4rl if path.suffix in (".hdf5", ".h5") else _read_safetensors
    dataset = read(path, setting)
    _check(dataset, path, setting)
    if bool(setting.config.images.channel) != bool(frames):
        wants = "sees frames: give those of the dataset with --frames" if frames is None else "sees no frames; leave --frames out"
        raise UserError(f"{setting.config.name} {wants}")
    if frames is None:
        return dataset
    drawn, rendering = frame_file.read(frames, dataset.sha256)
    if len(drawn) != int(dataset.offsets[-1]):
        raise UserError(f"{frames}: {len(drawn)} frames for {int(dataset.offsets[-1])} control steps; make it anew with lads-run frames")
    return replace(dataset, frames=drawn, frame_rows=np.arange(len(drawn)), rendering=rendering)


def sha256(path):
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(dataset, path, setting):
    """Checks what every reader must have established: shapes, finite values, a usable split."""
    sizes = {"O": setting.state_len, "A": setting.action_len}
    total = int(dataset.offsets[-1])
    for name, width in _WIDTHS.items():
        array = getattr(dataset, name)
        if array is None:
            continue
        if array.shape != (total, sizes[width]):
            raise UserError(f"{path}: {name} has shape {array.shape}, expected {(total, sizes[width])}")
        if not np.isfinite(array).all():
            raise UserError(f"{path}: {name} has values that are not finite")
    if len(dataset) == 0:
        raise UserError(f"{path}: no episode in it")
    if dataset.offsets[0] != 0 or (dataset.lengths() < 1).any():
        raise UserError(f"{path}: episode_offsets must start at 0 and grow")
    for key, limit in _longest(setting).items():
        if dataset.lengths().max() > limit:
            raise UserError(f"{path}: an episode has {dataset.lengths().max()} steps, more than the {limit} of {key}")
    if dataset.texts is not None:
        return
    for index in np.unique(dataset.instruction):
        if setting.instructions[index]["split"] != "seen":
            raise UserError(f"{path}: has demonstrations of the unseen instruction {setting.instructions[index]['id']!r}")


def _longest(setting):
    """Returns what bounds the length of an episode: {key of the configuration: control steps}."""
    config = setting.config
    longest = {"alignment.segments": config.alignment.segments * config.encoder.horizon}
    if config.beyond_context == "refuse":
        longest["high_level.context_steps"] = config.high_level.context_steps
    return longest


def _read_safetensors(path, setting):
    try:
        with safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise UserError(f"{path}: not a {FORMAT} file; lads-collect writes them")
            if metadata.get("version") != VERSION:
                raise UserError(f"{path}: version {metadata.get('version')!r} of {FORMAT}; this exporter reads {VERSION}")
            if metadata.get("environment") != setting.environment["id"]:
                raise UserError(f"{path}: of environment {metadata.get('environment')!r}, not {setting.environment['id']!r}")
            names = set(file.keys())
            missing = {"observations", "actions", "executed", "episode_offsets", "instruction"} - names
            if missing:
                raise UserError(f"{path}: tensor {sorted(missing)[0]!r} is missing")
            floats = {name: file.get_tensor(name).astype(np.float32) for name in _WIDTHS if name in names}
            offsets, labels = file.get_tensor("episode_offsets"), file.get_tensor("instruction")
            known = json.loads(metadata["instructions"])
    except (SafetensorError, KeyError, ValueError) as error:
        raise UserError(f"{path}: not a {FORMAT} file: {error}") from error
    ids = [row["id"] for row in setting.instructions]
    here = [row["id"] for row in known]
    if labels.size and not 0 <= labels.min() <= labels.max() < len(here):
        raise UserError(f"{path}: instruction has an index outside the metadata's list")
    own = [row["text"] for row in known] if setting.environment.get("labels") == "post-hoc" else None
    for index in np.unique(labels):
        if own is None and here[index] not in ids:
            raise UserError(f"{path}: instruction {here[index]!r} is not in {setting.config.instructions}")
    translate = np.arange(len(here)) if own else np.array([ids.index(name) if name in ids else -1 for name in here])
    notes = {key: metadata[key] for key in ("seed", "noise", "attempts", "discarded", "versions") if key in metadata}
    return Dataset(
        floats["observations"],
        floats.get("states"),
        floats["actions"],
        floats["executed"],
        offsets,
        translate[labels],
        sha256(path),
        notes,
        texts=own,
    )


def _completed(states, sub_tasks, radius):
    """Lists the names of the sub-tasks whose goal the states [T, O] come within `radius` of, in order of completion."""
    first = {}
    for task in sub_tasks:
        distance = np.linalg.norm(states[:, task["indices"]] - np.array(task["goal"]), axis=1)
        reached = np.flatnonzero(distance < radius)
        if len(reached):
            first[task["name"]] = reached[0]
    return sorted(first, key=first.get)


def _read_d4rl(path, setting):
    """Reads D4RL's kitchen: rows of 30 observations (and 30 goals, dropped); an episode ends at a terminal or a time-out.

    Each episode is labelled with the seen instruction that names just the sub-tasks completed in it.
    """
    try:
        import h5py
    except ImportError as error:
        raise UserError(f"{path}: D4RL files are read by h5py: pip install -e 'exporter[d4rl]'") from error
    try:
        with h5py.File(path) as file:
            observations, actions = file["observations"][:], file["actions"][:]
            ends = file["terminals"][:].astype(bool)
            if "timeouts" in file:
                ends = ends | file["timeouts"][:].astype(bool)
    except (OSError, KeyError) as error:
        raise UserError(f"{path}: not a D4RL HDF5 file: {error}") from error
    if "sub_task" not in setting.environment:
        raise UserError(f"{setting.config.environment}: no sub_task table, which labels D4RL episodes")
    sub_tasks, radius = setting.environment["sub_task"], setting.environment["sub_task_radius"]
    width = setting.state_len
    if observations.ndim != 2 or observations.shape[1] < width or len(observations) != len(actions) or len(ends) != len(actions):
        raise UserError(f"{path}: not a D4RL kitchen file: observations {observations.shape}, actions {actions.shape}")
    labels = {frozenset(row["sub_tasks"]): index for index, row in enumerate(setting.instructions) if row["split"] == "seen"}
    unseen = {frozenset(row["sub_tasks"]) for row in setting.instructions if row["split"] == "unseen"}
    kept, rows, notes = [], [], Counter()
    stops = [*(np.flatnonzero(ends) + 1), len(ends)]
    for start, stop in zip([0, *stops], stops):
        if start == stop:
            continue
        states = observations[start:stop, :width]
        done = frozenset(_completed(states, sub_tasks, radius))
        if done in labels and stop - start <= min(_longest(setting).values()):
            kept.append(labels[done])
            rows.append(np.arange(start, stop))
        elif done in labels:
            notes["left_out_too_long"] += 1
        else:
            notes["left_out_unseen" if done in unseen else "left_out_other_sub_tasks"] += 1
    if not kept:
        raise UserError(f"{path}: no episode completes the sub-tasks of a seen instruction")
    chosen = np.concatenate(rows)
    offsets = np.cumsum([0, *(len(row) for row in rows)])
    actions = actions[chosen].astype(np.float32)
    states = observations[chosen, :width].astype(np.float32)
    return Dataset(states, None, actions, np.clip(actions, -1, 1), offsets, np.array(kept), sha256(path), dict(notes))
