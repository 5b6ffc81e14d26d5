"""Frames of a camera as what policies learn from and act on: the file and the stream of `lads-run frames`, augmentation, a corpus of images.

Shapes: N frames, r rows, c columns, F features; E episodes, T control steps. Frames are bytes [r, c, 3]; between augmentation and encoder they
are floats 0 to 255. What can fail: a file that is half written, or of another dataset; a program that
is not there or cannot draw.
"""

import hashlib
import json
import math
import mmap
import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from .config import UserError
from .corpus import Corpus

FORMAT = "lads-frames"
DIGEST = 16  # bytes of a frame's sha256 by which it is known again
BATCH = 256  # frames that are encoded at a time where nothing is learnt
RED, GREEN, BLUE = 0.299, 0.587, 0.114  # of a pixel's luminance


def read(path, dataset_sha256):
    """-> frames [T, r, c, 3] as an array over the file, how they were rendered."""
    try:
        with open(path, "rb") as file:
            whole = file.seek(0, 2)
            file.seek(0)
            (length,) = struct.unpack("<Q", file.read(8))
            if length > whole - 8:
                raise ValueError("a header beyond the end")
            header = json.loads(file.read(length))
            data = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8, offset=8 + length)
        metadata, shape = header["__metadata__"], header["frames"]["shape"]
        rendering = json.loads(metadata["rendering"])
        fits = metadata["format"] == FORMAT and header["frames"]["dtype"] == "U8" and shape == [shape[0], *rendering["size"], 3]
        whole, made_of = fits and len(data) == math.prod(shape), metadata["dataset_sha256"]
    except (OSError, ValueError, LookupError, struct.error, TypeError) as error:
        raise UserError(f"{path}: no frames ({type(error).__name__}); make them with lads-run frames") from error
    if not whole:
        raise UserError(f"{path}: not a whole {FORMAT} file; make it with lads-run frames")
    if made_of != dataset_sha256:
        raise UserError(f"{path}: made of another dataset; make it anew with lads-run frames")
    return data.reshape(shape), rendering


def digest(frame):
    """-> the first DIGEST bytes of a frame's sha256."""
    return np.frombuffer(hashlib.sha256(np.ascontiguousarray(frame)).digest(), np.uint8)[:DIGEST]


class Renderer:
    """Draws frames of states: `lads-run frames --stream`, which draws them for the harness too, as its own process.

    `versions` are those of what draws, by name.
    """

    def __init__(self, program, environment, rendering):
        self.program, self.errors, folder = program, tempfile.TemporaryFile(), tempfile.TemporaryDirectory()
        with folder:
            file = Path(folder.name, "rendering.json")
            file.write_text(json.dumps(rendering))
            command = [program, "frames", "--stream", environment, "--rendering", file]
            try:
                self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors)
            except OSError as error:
                raise UserError(f"{program}: cannot be run ({error.strerror}); build it: cargo build --release -p lads-sim --features camera, or name it with --lads-run") from error
            heading = self.process.stdout.readline()
        if not heading.endswith(b"\n"):
            self._broke()
        heading = json.loads(heading)
        self.versions, self.positions, self.shape = heading["versions"], heading["positions"], (*rendering["size"], 3)

    def draw(self, state):
        """Draws the frame of a state, the simulator's positions -> [r, c, 3] of bytes."""
        state = np.ascontiguousarray(state, "<f8")
        if state.shape != (self.positions,):
            raise UserError(f"{self.program}: draws states of {self.positions} numbers, not of {state.size}")
        try:
            self.process.stdin.write(state.tobytes())
            self.process.stdin.flush()
        except BrokenPipeError:
            self._broke()
        drawn = self.process.stdout.read(math.prod(self.shape))
        if len(drawn) < math.prod(self.shape):
            self._broke()
        return np.frombuffer(drawn, np.uint8).reshape(self.shape)

    def close(self):
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait()
        self.errors.close()

    def _broke(self):
        self.process.wait()
        self.errors.seek(0)
        said = self.errors.read().decode(errors="replace").strip() or f"ended with exit code {self.process.returncode}"
        raise UserError(f"{self.program}: {said.removeprefix('error: ')}")


def augmented(frames, owners, count, config):
    """frames [N, r, c, 3] of bytes, each of one of `count` owners [N] -> floats, every owner's changed alike.

    LISA's augmentation: colours jittered, then turned, shifted and scaled, black where nothing is. The colours' changes are linear here (a
    hue is a turn about the grey axis) and come in one order.
    """
    with frames.device:
        x = frames.float()
        draw = lambda low, high: torch.empty(count).uniform_(low, high)
        bright, contrast, saturation = (draw(1 - config.jitter, 1 + config.jitter) for _ in range(3))
        hue = draw(-config.jitter, config.jitter) * 2 * math.pi
        grey = torch.tensor([RED, GREEN, BLUE])
        x = x @ (bright[:, None, None] * _colours(saturation, hue, grey)).transpose(1, 2)[owners][:, None]
        mean = (x @ grey).mean((1, 2))[:, None, None, None]
        share = contrast[owners][:, None, None, None]
        x = (mean + share * (x - mean)).clamp(0, 255)
        if not (config.turn_degrees or config.shift or config.scale):
            return x
        angle, scale = draw(-config.turn_degrees, config.turn_degrees) * math.pi / 180, draw(1 - config.scale, 1 + config.scale)
        cos, sin = angle.cos() / scale, angle.sin() / scale
        shift = [2 * draw(-config.shift, config.shift) for _ in range(2)]
        turns = torch.stack([torch.stack([cos, sin, shift[0]], 1), torch.stack([-sin, cos, shift[1]], 1)], 1)
        x = x.permute(0, 3, 1, 2)
        grid = F.affine_grid(turns[owners], x.shape, align_corners=False)
        return F.grid_sample(x, grid, "nearest", "zeros", align_corners=False).permute(0, 2, 3, 1)


def _colours(saturation, hue, grey):
    """[B, 3, 3]: colours less grey by `saturation`, turned about the grey axis by `hue` radians."""
    axis = torch.full((3,), 3**-0.5)
    cross = torch.tensor([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    cos, sin = hue.cos()[:, None, None], hue.sin()[:, None, None]
    turned = cos * torch.eye(3) + sin * cross + (1 - cos) * torch.outer(axis, axis)
    share = saturation[:, None, None]
    return (share * torch.eye(3) + (1 - share) * grey.expand(3, 3)) @ turned


class FrameCorpus(Corpus):
    """A corpus whose observations are features of frames: those of `encode`, once they are frozen; until then callers bring their own."""

    def __init__(self, dataset, setting, encoded, device):
        super().__init__(dataset, setting, encoded, device)
        self.frames = dataset.frames
        self.shown_states = self.observations  # [E, T, O] the normalised states that the frames show
        self.places = self._padded(torch.from_numpy(dataset.frame_rows)[:, None], dataset)[..., 0]
        features = setting.observation_len
        self.observations = torch.zeros(*self.places.shape, features, device=device)
        self.mean, self.std = torch.zeros(features), torch.ones(features)

    def seen(self, episodes):
        """The frames of episodes -> frames [N, r, c, 3], rows [N] of `episodes`, steps [N]."""
        valid = torch.arange(self.steps) < self.lengths[episodes][:, None]
        rows, steps = valid.nonzero(as_tuple=True)
        return self.frames_at(episodes[rows], steps), rows, steps

    def frames_at(self, episodes, steps):
        """The frames [N, r, c, 3] at episodes [N] and steps [N]."""
        places = self.places[episodes.to(self.device), steps.to(self.device)].cpu().numpy()
        return torch.from_numpy(self.frames[places]).to(self.device)

    @torch.no_grad()
    def freeze(self, encode):
        """Every frame's features, once; episodes that share a frame share them."""
        used = torch.unique(self.places.cpu())
        features = torch.zeros(int(used.max()) + 1, self.observations.shape[-1], device=self.device)
        for part in used.split(BATCH):
            features[part.to(self.device)] = encode(torch.from_numpy(self.frames[part.numpy()]).to(self.device))
        valid = torch.arange(self.steps) < self.lengths[:, None]
        self.observations = features[self.places] * valid[..., None].to(self.device)
