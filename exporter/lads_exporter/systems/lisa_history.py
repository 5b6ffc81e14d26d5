"""LISA with LADS' low level of the kitchen from images: a causal transformer over the option, a window of steps before it and those under it (Table 9).

The high level, its losses and its departures are those of `lisa`; an option goes to the low level once, so that its gradient is not split.
"""

import torch
from torch import nn

from ..kinds import history, sighted_history
from ..model import start_weights
from . import base, lisa
from .base import Exported
from .windows import Windows


class Networks(lisa.Quantised):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        sizes = sighted_history.low_level_sizes(setting, encoded)
        hidden = setting.config.high_level.hidden
        self.project_out = nn.Linear(sizes.plan, hidden)
        self.low_level = history.HistoryPolicy(sizes, nn.Linear(hidden, sizes.hidden))
        start_weights(self.low_level)

    def option_table(self):
        """Computes the options of all codes [M, d], before the low level embeds them."""
        return self.project_out(self.codebook.codes)

    @torch.no_grad()
    def acting_low_level(self):
        """Returns the low level with a table of the embedded options in place of the layer that embeds them."""
        return self.low_level.with_table(self.option_table())


class Training(Windows, lisa.Training):
    def chunks(self, episodes):
        """Computes the losses of chunks of H steps, and their codes."""
        latents, chunks = self.latents(episodes, self.corpus.horizon)
        plans, index, commitment = self.networks.codebook(latents)
        first = chunks.places[:, 0]
        bc = self.in_windows(first // self.corpus.steps, first % self.corpus.steps, self.networks.project_out(plans))
        return {"bc": bc, "commitment": commitment}, index


@torch.no_grad()
def acting(networks, setting, encoded):
    """Returns the policy that acts, its quantiser folded."""
    policy = nn.Module()
    policy.normalizer, policy.high_level, policy.low_level = networks.normalizer, networks.folded(), networks.acting_low_level()
    return base.with_eyes(policy, networks).eval()


def export(networks, setting, encoded):
    high, low = base.sizes(setting, encoded), sighted_history.low_level_sizes(setting, encoded)
    made = history.build(acting(networks, setting, encoded), high, low)
    return Exported(made, history.family(low, base.decision(setting)))
