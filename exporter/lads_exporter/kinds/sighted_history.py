"""`sighted_history`: LADS on a frozen encoder's features; its low level is the transformer of `history`, over a window of earlier steps."""

import dataclasses

import torch
from torch import nn

from .. import config, graphs, random_policy
from ..model import Lads, TrajectoryEncoder, start_weights
from . import common, frozen, history, lads


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
    """The networks of LADS on features, with the low level that has a window."""

    def __init__(self, setting, encoded, head=None):
        super().__init__(setting, encoded, head)
        encoder, sizes = setting.config.encoder, low_level_sizes(setting, encoded)
        # It is shown only what it looks at, which the joints alone may be.
        width = encoder.observed or setting.observation_len
        self.encoder = TrajectoryEncoder(encoder.hidden, width, setting.action_len, encoder.codebook_dim, width, encoder.relative)
        self.low_level = history.HistoryPolicy(sizes, nn.Linear(encoder.codebook_dim, sizes.hidden))
        start_weights(self.low_level)

    @torch.no_grad()
    def acting_low_level(self):
        """Returns the low level with a table of the embedded plans in place of the layer that embeds them."""
        return self.low_level.with_table(self.codebook.codes)


def graph(networks, setting, encoded):
    """Builds all entries but the trajectory encoder, which reads features that nobody outside has."""
    made = graphs.Graph()
    graphs.known_instructions(made, networks.high_level, encoded)
    graphs.see(made, networks)
    for first in (True, False):
        graphs.high_level_step(made, networks.high_level, None, first)
    history.add_low_level(made, networks.acting_low_level(), None, low_level_sizes(setting, encoded))
    return made.model("history")


def family(setting, encoded, decision):
    """Makes what the contract says of such a policy."""
    return history.family(low_level_sizes(setting, encoded), decision) | {"actions": True}


def _setting(sizes):
    made = lads.setting(sizes)
    remembers = config.History(sizes.window, sizes.low_level_layers, sizes.heads, 0.0)
    return dataclasses.replace(made, config=dataclasses.replace(made.config, pretrained=frozen.SEEN, history=remembers), rendering={"size": frozen.SIZE})


def policy(sizes, seed):
    made = _setting(sizes)
    networks = Remembering(made, common.WORDS)
    random_policy.randomize(networks, made, seed, placed=False)
    frozen.give_random_eyes(networks, seed)
    with torch.no_grad():
        positions = networks.low_level.embed_position.weight
        positions.copy_(0.3 * torch.randn(positions.shape, generator=torch.Generator().manual_seed(seed)))
        networks.low_level.head.weight.mul_(0.3)
    return networks.eval()


def build(networks, sizes):
    return graph(networks, _setting(sizes), common.WORDS)


def contract(sizes, seed):
    return frozen.contract_of(family(_setting(sizes), common.WORDS, common.argmax()), sizes, seed)
