"""`sighted`: policies on frames of a camera. An encoder of its own entry runs once in a control step, and all levels read its features."""

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
HANDED = SEEN.features  # elements that its encoder hands on


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

    def add(self, graph):
        """Adds the entry to a graph, whose later entries read its features."""
        entry = graphs.Entry(graph, ENTRY)
        x, last = self.convolutions.build(entry), len(self.dense) - 1
        for number, layer in enumerate(self.dense):
            weight, bias = (entry.weight(f"observation_encoder.dense.{number}.{part}", getattr(layer, part)) for part in ("weight", "bias"))
            x = entry.gemm(x, weight, bias, FEATURES if number == last else f"dense.{number}")
            x = x if number == last else entry.op("Relu", [x], f"dense.{number}.relu")
        entry.output(FEATURES, [1, self.dense[-1].out_features])
        graph.observed = FEATURES


def give_eyes(networks, setting, encoded):
    """Adds to networks on features the encoder that makes them, and what reads the state in them while it learns.

    Both start from the same weights whatever the system: those that follow LADS' own.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(torch.initial_seed())
        Lads(setting, encoded)
        networks.frames = FrameEncoder(setting.config.images, setting.rendering["size"])
        networks.state = nn.Linear(setting.observation_len, setting.state_len)
    return networks


def policy(sizes, seed):
    made = lads.setting(sizes)
    made = dataclasses.replace(made, config=dataclasses.replace(made.config, images=SEEN), rendering={"size": SIZE})
    networks = give_eyes(Lads(made, common.WORDS), made, common.WORDS)
    random_policy.randomize(networks, made, seed)
    return networks.eval()


def contract(sizes, seed):
    return contract_of({"kind": "lads", "horizon": sizes.horizon, "codebook": sizes.codebook, "decision": common.argmax()}, sizes, seed)


def of_kind(network, seed):
    """Makes a random policy of another family on features: `network`, whose observation they are, with the encoder that makes them."""
    network.frames = FrameEncoder(SEEN, SIZE)
    common.randomize(network, seed)
    with torch.no_grad():
        network.frames.dense[-1].weight.mul_(4)  # frames of noise look much alike
    return network


def contract_of(family, sizes, seed, noise=None):
    """Makes the contract of a random policy on features."""
    return common.contract(family | {"features": HANDED}, sizes, seed, noise=noise, image=contracts.camera(SEEN.channel, SIZE))
