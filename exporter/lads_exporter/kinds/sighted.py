"""`sighted`: LADS on frames of a camera. An encoder of its own entry runs once in a control step, and both levels read its features."""

import dataclasses

import torch
import torch.nn.functional as F
from torch import nn

from .. import config, contract as contracts, graphs, random_policy
from ..model import Lads
from . import common, images, lads

ENTRY, FEATURES = "observation_encoder/encode", "features"
SIZE = (12, 16)  # rows and columns of the random policy's camera
SEEN = config.Images("camera", [4, 8], [24], 16, 0.0, 0.0, 0.0, 0.0, 0.0, config.Stage(**config.NO_STAGE))


class FrameEncoder(nn.Module):
    """Convolutions with kernels of 4 and strides 2 and 1 by turns, then dense layers: the paper's encoder of 64x64 frames."""

    def __init__(self, seen, size):
        super().__init__()
        self.convolutions = images.Encoder(images.Camera(seen.channel, tuple(size), images.lorel(seen.widths)))
        widths = [self.convolutions.features(), *seen.hidden, seen.features]
        self.dense = nn.ModuleList(nn.Linear(k, n) for k, n in zip(widths, widths[1:]))

    def forward(self, frames):
        """frames [N, rows, columns, 3], 0 to 255 -> features [N, F]."""
        x = self.convolutions(frames)
        for layer in self.dense[:-1]:
            x = F.relu(layer(x))
        return self.dense[-1](x)

    def build(self, graph):
        """Adds the entry to a graph."""
        entry = graphs.Entry(graph, ENTRY)
        x, last = self.convolutions.build(entry), len(self.dense) - 1
        for number, layer in enumerate(self.dense):
            weight, bias = (entry.weight(f"observation_encoder.dense.{number}.{part}", getattr(layer, part)) for part in ("weight", "bias"))
            x = entry.gemm(x, weight, bias, FEATURES if number == last else f"dense.{number}")
            x = x if number == last else entry.op("Relu", [x], f"dense.{number}.relu")
        entry.output(FEATURES, [1, self.dense[-1].out_features])


class Sighted(Lads):
    """The networks of LADS on features, the encoder that makes them, and what reads the state in them while they are learnt."""

    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        self.frames = FrameEncoder(setting.config.images, setting.rendering["size"])
        self.state = nn.Linear(setting.observation_len, setting.state_len)


def graph(networks, encoded):
    """Makes the graph of all entries but the trajectory encoder, whose features no caller has."""
    made = graphs.Graph()
    graphs.known_instructions(made, networks.high_level, encoded)
    networks.frames.build(made)
    for first in (True, False):
        graphs.high_level_step(made, networks.high_level, networks.normalizer, first, observed=FEATURES)
    graphs.codebook_lookup(made, graphs.to_numpy(networks.codebook.codes))
    graphs.low_level_act(made, networks.low_level, networks.normalizer, observed=FEATURES)
    return made.model("lads")


def policy(sizes, seed):
    made = lads.setting(sizes)
    made = dataclasses.replace(made, config=dataclasses.replace(made.config, images=SEEN), rendering={"size": SIZE})
    networks = Sighted(made, common.WORDS)
    random_policy.randomize(networks, made, seed)
    return networks.eval()


def build(networks, sizes):
    return graph(networks, common.WORDS)


def contract(sizes, seed):
    family = {"kind": "lads", "horizon": sizes.horizon, "codebook": sizes.codebook, "decision": common.argmax(), "features": SEEN.features}
    image = contracts.array(SEEN.channel, "observation", [*SIZE, 3], "u8", layout="hwc", min=0, max=255)
    return common.contract(family, sizes, seed, image=image)
