"""`frozen`: policies on a frozen encoder's features of a camera's frames, behind the first elements of the state. The encoder has an entry of its
own, which runs once in a control step; what it hands to all levels is [joints, features], normalised and clipped.
"""

import torch
from torch import nn

from .. import config, contract as contracts, encoders, graphs
from ..model import Normalizer
from . import common
from .sighted import ENTRY, FEATURES

SIZE = (16, 20)  # rows and columns of the random policy's camera
SEEN = config.Pretrained("camera", "random-4", 48, 4, 0.1, 2.0)  # a clip that is felt
HANDED = SEEN.joints + SEEN.features  # elements that its encoder hands on


class FrozenEncoder(nn.Module):
    """The encoder, and the statistics that its features and the joints are normalised by."""

    def __init__(self, seen, size):
        super().__init__()
        self.joints, self.clip = seen.joints, seen.clip
        self.network = encoders.network(seen.encoder, seen.channel, size)
        self.normalizer = Normalizer(seen.joints + seen.features)

    def forward(self, joints, frames):
        """Computes what all levels observe: joints [N, J], frames [N, rows, columns, 3] of bytes -> [N, J + F]."""
        return self.normalizer(torch.cat([joints, self.network(frames)], -1)).clamp(-self.clip, self.clip)

    def add(self, graph):
        """Adds the entry to a graph, whose later entries read what it hands on."""
        entry = graphs.Entry(graph, ENTRY)
        joints, width = entry.input(contracts.OBSERVATION, [1, self.joints]), len(self.normalizer.mean)
        flat = self.network.build(entry)
        both = entry.op("Concat", [joints, flat], "joints_and_features", axis=1)
        mean, std = (entry.weight(f"observation_encoder.{name}", getattr(self.normalizer, name)) for name in ("mean", "std"))
        x = entry.op("Div", [entry.op("Sub", [both, mean], "centred"), std], "normalised")
        entry.op("Clip", [x, entry.scalar("lowest", -self.clip), entry.scalar("highest", self.clip)], FEATURES)
        entry.output(FEATURES, [1, width])
        graph.observed = FEATURES


def give_eyes(networks, setting):
    """Adds the encoder to networks on what it hands on; its weights and statistics are not known yet."""
    networks.frames = FrozenEncoder(setting.config.pretrained, setting.rendering["size"])
    return networks


def give_random_eyes(networks, seed):
    """Adds the encoder of random policies, with random statistics of what it hands on."""
    networks.frames = FrozenEncoder(SEEN, SIZE)
    networks.frames.network = encoders.load(SEEN.encoder, SEEN.channel, SIZE)[0]
    known, generator = networks.frames.normalizer, torch.Generator().manual_seed(seed)
    known.std.copy_(0.2 + torch.rand(known.std.shape, generator=generator))
    known.mean.copy_(0.1 * torch.randn(known.mean.shape, generator=generator))
    return networks


def of_kind(network, seed):
    """Makes a random policy of another family: `network`, whose observation is what the encoder hands on."""
    return give_random_eyes(common.randomize(network, seed, placed=False), seed).eval()


def contract_of(family, sizes, seed, noise=None):
    """Makes the contract of a random policy on what such an encoder hands on."""
    return common.contract(family | {"features": HANDED}, sizes, seed, noise=noise, image=contracts.camera(SEEN.channel, SIZE), joints=SEEN.joints)
