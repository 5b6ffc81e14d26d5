"""Features of a dataset's frames: drawn by lads-run, encoded once by a frozen encoder, and only the features kept.

The file: safetensors of `features` [T, F] (f16, a row for each control step of the dataset), `frames` [G, r, c, 3] (u8) and `frame_rows` [G]
(i64): the few frames that golden episodes are made of, and the steps they are of. The metadata names dataset, rendering and encoder. It is made in parts
in the folder FILE.parts, so that work that was stopped goes on, and frames take no more room than a part's. What can fail: no lads-run with
cameras, no encoder, parts of something else, a file of another dataset or encoder.
"""

import hashlib
import json
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from tqdm import tqdm

from . import dataset as datasets, encoders, frames, graphs, twin
from .config import UserError
from .output import write_atomically

FORMAT, VERSION = "lads-features", "1"
PART = 500  # frames that are drawn at a time: 75 MB of 224x224 pixels
GOLDEN = 6  # episodes that may become the golden one


@dataclass(frozen=True)
class Features:
    """Features of a dataset, and what they are of."""

    rows: np.ndarray  # [T, F] float16
    frames: dict  # step: frame [r, c, 3]
    rendering: dict
    encoder: str  # sha256 of its weights


def golden_steps(setting):
    """Returns how long golden episodes on frames are: over two changes of the plan, since frames are large."""
    return 2 * setting.config.encoder.horizon + 2


def golden_episodes(dataset, setting):
    """Lists held-out episodes that may become the golden one, with the slices of their first steps."""
    every = setting.config.data.validation_every
    held_out = range(every - 1, len(dataset), every) if every > 0 else range(0)
    chosen = list(held_out)[:: max(1, len(held_out) // GOLDEN)][:GOLDEN]
    starts = dataset.offsets
    return [(e, slice(int(starts[e]), min(int(starts[e + 1]), int(starts[e]) + golden_steps(setting)))) for e in chosen]


def read(path, setting, dataset_sha256):
    """Reads a file of features of a dataset for a setting -> `Features`."""
    try:
        with safe_open(path, "numpy") as file:
            said = file.metadata() or {}
            found = {name: file.get_tensor(name) for name in ("features", "frames", "frame_rows")}
        rendering = json.loads(said["rendering"])
        encoder, name, made_of = said["encoder_sha256"], said["encoder"], said["dataset_sha256"]
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise UserError(f"{path}: no features ({type(error).__name__}); make them with python -m lads_exporter features") from error
    seen = setting.config.pretrained
    problems = []
    if (said.get("format"), said.get("version")) != (FORMAT, VERSION):
        problems.append(f"its format is {said.get('format')} {said.get('version')}, not {FORMAT} {VERSION}")
    if made_of != dataset_sha256:
        problems.append("made of another dataset")
    if name != Path(seen.encoder).name:
        problems.append(f"made by the encoder {name}, the configuration names {seen.encoder}")
    if found["features"].ndim != 2 or found["features"].shape[1] != seen.features:
        problems.append(f"has the shape {found['features'].shape}, the configuration says {seen.features} features")
    if problems:
        raise UserError(f"{path}: {'; '.join(problems)}; make it anew with python -m lads_exporter features")
    drawn = dict(zip(found["frame_rows"].tolist(), found["frames"]))
    return Features(found["features"], drawn, rendering, encoder)


def attach(dataset, setting, path):
    """Adds to a dataset the features at `path`, None for a setting without a frozen encoder."""
    if bool(setting.config.pretrained.encoder) != bool(path):
        wants = "sees features: give those of the dataset with --features" if path is None else "sees no features; leave --features out"
        raise UserError(f"{setting.config.name} {wants}")
    if path is None:
        return dataset
    found = read(path, setting, dataset.sha256)
    if len(found.rows) != int(dataset.offsets[-1]):
        raise UserError(f"{path}: {len(found.rows)} rows for {int(dataset.offsets[-1])} control steps; make it anew with python -m lads_exporter features")
    return replace(dataset, features=found, frame_rows=np.arange(len(found.rows)), rendering=found.rendering)


def make(setting, data, path, lads_run, threads=0, quiet=False):
    """Draws and encodes every state of the dataset at `data` into the file at `path`, or goes on with it."""
    dataset = datasets.load(data, setting)
    states = dataset.observations if dataset.states is None else dataset.states
    path, folder = Path(path), Path(f"{path}.parts")
    if path.exists():
        read(path, setting, dataset.sha256)
        return
    folder.mkdir(parents=True, exist_ok=True)
    wanted = np.zeros(len(states), bool)
    for _, rows in golden_episodes(dataset, setting):
        wanted[rows] = True
    encode, parts = None, []
    starts = range(0, len(states), PART)
    for number, start in enumerate(tqdm(starts, desc="features", unit="part", disable=quiet or None)):
        rows = np.arange(start, min(start + PART, len(states)))
        part = folder / f"{number:05}.safetensors"
        parts.append(part)
        if part.exists():
            continue
        drawn, rendering = _draw(states[rows], setting, folder, lads_run, threads)
        encode = encode or Encoder(setting, rendering)
        tensors = {"features": encode(drawn), "frames": np.ascontiguousarray(drawn[wanted[rows]]), "frame_rows": rows[wanted[rows]]}
        write_atomically(part, save(tensors, metadata=_metadata(setting, dataset, rendering, encode.sha256)))
    write_atomically(path, _whole(parts, path))
    shutil.rmtree(folder)
    read(path, setting, dataset.sha256)


def _metadata(setting, dataset, rendering, encoder_sha256):
    """Makes the metadata of a file of features and of its parts, so that those of different things do not come together."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "dataset_sha256": dataset.sha256,
        "rendering": json.dumps(rendering, sort_keys=True),
        "encoder": Path(setting.config.pretrained.encoder).name,
        "encoder_sha256": encoder_sha256,
    }


def _whole(parts, path):
    """Puts the parts together -> the bytes of the file."""
    said, found = {}, []
    for part in parts:
        try:
            with safe_open(part, "numpy") as file:
                said.setdefault(json.dumps(file.metadata(), sort_keys=True), file.metadata())
                found.append({name: file.get_tensor(name) for name in file.keys()})
        except (OSError, SafetensorError) as error:
            raise UserError(f"{part}: damaged ({type(error).__name__}); remove it, and the same command makes it again") from error
    if len(said) > 1:
        raise UserError(f"{path}.parts: its parts are of different datasets, renderings or encoders; remove the folder, or write to another file")
    tensors = {name: np.concatenate([row[name] for row in found]) for name in found[0]}
    return save(tensors, metadata=next(iter(said.values())))


def _draw(states, setting, folder, lads_run, threads):
    """Draws some states by lads-run -> frames [n, r, c, 3], how they were rendered; the files in between are removed."""
    with tempfile.TemporaryDirectory(dir=folder) as room:
        data, drawn = Path(room) / "states.safetensors", Path(room) / "frames"
        metadata = {"format": datasets.FORMAT, "version": datasets.VERSION, "environment": setting.environment["id"]}
        data.write_bytes(save({"states": np.ascontiguousarray(states, np.float32)}, metadata=metadata))
        command = [str(lads_run), "frames", str(data), "-o", str(drawn), *(["--threads", str(threads)] if threads else [])]
        try:
            done = subprocess.run(command, capture_output=True, text=True)
        except OSError as error:
            raise UserError(f"{lads_run}: {error.strerror}; build it: cargo build --release -p lads-sim --features camera --bin lads-run") from error
        if done.returncode:
            said = (done.stderr.strip() or "it says nothing").splitlines()[-1]
            raise UserError(f"{lads_run} frames: {said}")
        found, rendering = frames.read(drawn, hashlib.sha256(data.read_bytes()).hexdigest())
        if len(found) != len(states):
            raise UserError(f"{lads_run} frames: {len(found)} frames for {len(states)} states")
        return np.array(found), rendering


class Encoder:
    """A frozen encoder as a bundle has it: its graph in ONNX Runtime, which takes a quarter of PyTorch's time."""

    def __init__(self, setting, rendering):
        seen = setting.config.pretrained
        network, self.sha256 = encoders.load(seen.encoder, seen.channel, rendering["size"])
        features = network.features()
        if features != seen.features:
            raise UserError(f"pretrained.features = {seen.features}: {seen.encoder} gives {features} features")
        graph = graphs.Graph()
        entry = graphs.Entry(graph, "encoder")
        entry.op("Identity", [network.build(entry)], "features")
        entry.output("features", [1, features])
        self.channel, self.entry = seen.channel, twin.Entry(graph.model("encoder"), "encoder")

    def __call__(self, drawn):
        """Encodes frames [n, r, c, 3] -> features [n, F] float16."""
        found = np.concatenate([self.entry.run({self.channel: frame[None]})["features"] for frame in drawn])
        largest = np.finfo(np.float16).max
        if not np.isfinite(found).all() or np.abs(found).max() > largest:
            raise UserError(f"the encoder gives features beyond {largest:.0f}, which half precision does not hold")
        return found.astype(np.float16)
