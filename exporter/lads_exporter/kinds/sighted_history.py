"""`sighted_history`: LADS on a frozen encoder's features of a camera's frames, beside the first elements of the state; its low level is the
transformer of `history`, over a window of earlier steps.

The encoder's entry runs once in a control step. What it hands to both levels is [joints, features], normalised and clipped.
"""

import copy
import dataclasses

import torch
from torch import nn

from .. import config, contract as contracts, encoders, graphs, random_policy
from ..model import Lads, TrajectoryEncoder, start_weights
from . import common, history, lads
from .sighted import ENTRY, FEATURES

SIZE = (16, 20)  # rows and columns of the random policy's camera
SEEN = config.Pretrained("camera", "random-4", 48, 4, 0.1, 2.0)  # a clip that is felt


def low_level_sizes(setting, encoded):
    """Returns the sizes of the low level's transformer and of its window."""
    made, encoder = setting.config, setting.config.encoder
    return common.Sizes(
        observation=setting.observation_len,
        action=setting.action_len,
        words=encoded,
        hidden=made.low_level.hidden,
        heads=made.history.heads,
        dropout=made.history.dropout,
        horizon=encoder.horizon,
        codes=encoder.codebook_size,
        plan=encoder.codebook_dim,
        window=made.history.window,
        low_level_layers=made.history.layers,
    )


class Remembering(Lads):
    """The networks of LADS on features, the frozen encoder of frames, and the low level with a window."""

    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        seen, encoder, sizes = setting.config.pretrained, setting.config.encoder, low_level_sizes(setting, encoded)
        self.clip, self.joints = seen.clip, seen.joints
        self.frames = encoders.network(seen.encoder, seen.channel, setting.rendering["size"])
        # It is shown only what it looks at, which the joints alone may be.
        width = encoder.observed or setting.observation_len
        self.encoder = TrajectoryEncoder(encoder.hidden, width, setting.action_len, encoder.codebook_dim, width, encoder.relative)
        self.low_level = history.HistoryPolicy(sizes, nn.Linear(encoder.codebook_dim, sizes.hidden))
        start_weights(self.low_level)

    def observed(self, joints, frames):
        """Computes what both levels observe: joints [N, J], frames [N, rows, columns, 3] of bytes -> [N, J + F]."""
        return self.normalizer(torch.cat([joints, self.frames(frames)], -1)).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def acting_low_level(self):
        """Returns the low level with a table of the embedded plans in place of the layer that embeds them."""
        acting = copy.deepcopy(self.low_level)
        rows = self.low_level.embed_option(self.codebook.codes)
        acting.embed_option = nn.Embedding(*rows.shape).requires_grad_(False)
        acting.embed_option.weight.copy_(rows)
        return acting.eval()


def _encode(graph, networks):
    """Adds the entry of the encoder: the frame's features behind the joints, normalised and clipped."""
    entry = graphs.Entry(graph, ENTRY)
    joints, width = entry.input(contracts.OBSERVATION, [1, networks.joints]), len(networks.normalizer.mean)
    flat = networks.frames.build(entry)
    both = entry.op("Concat", [joints, flat], "joints_and_features", axis=1)
    x = entry.centred(both, networks.normalizer, "centred")
    x = entry.op("Div", [x, entry.weight("observation_std", networks.normalizer.std)], "normalised")
    entry.op("Clip", [x, entry.scalar("lowest", -networks.clip), entry.scalar("highest", networks.clip)], FEATURES)
    entry.output(FEATURES, [1, width])
    graph.observed = FEATURES


def graph(networks, setting, encoded):
    """Builds all entries but the trajectory encoder, which reads features that nobody outside has."""
    made = graphs.Graph()
    graphs.known_instructions(made, networks.high_level, encoded)
    _encode(made, networks)
    for first in (True, False):
        graphs.high_level_step(made, networks.high_level, None, first)
    history.add_low_level(made, networks.acting_low_level(), None, low_level_sizes(setting, encoded))
    return made.model("history")


def family(setting, encoded, decision):
    """Makes what the contract says of such a policy."""
    return history.family(low_level_sizes(setting, encoded), decision) | {"features": setting.observation_len, "actions": True}


def _setting(sizes):
    made = lads.setting(sizes)
    remembers = config.History(sizes.window, sizes.low_level_layers, sizes.heads, 0.0)
    return dataclasses.replace(made, config=dataclasses.replace(made.config, pretrained=SEEN, history=remembers), rendering={"size": SIZE})


def policy(sizes, seed):
    made = _setting(sizes)
    networks = Remembering(made, common.WORDS)
    random_policy.randomize(networks, made, seed)
    networks.frames = encoders.load(SEEN.encoder, SEEN.channel, SIZE)[0]
    with torch.no_grad():
        generator = torch.Generator().manual_seed(seed)
        positions = networks.low_level.embed_position.weight
        positions.copy_(0.3 * torch.randn(positions.shape, generator=generator))
        networks.low_level.head.weight.mul_(0.3)
        networks.normalizer.std.copy_(0.2 + torch.rand(networks.normalizer.std.shape, generator=generator))
    return networks.eval()


def build(networks, sizes):
    return graph(networks, _setting(sizes), common.WORDS)


def contract(sizes, seed):
    image = contracts.array(SEEN.channel, "observation", [*SIZE, 3], "u8", layout="hwc", min=0, max=255)
    return common.contract(family(_setting(sizes), common.WORDS, common.argmax()), sizes, seed, image=image, joints=SEEN.joints)
