"""LADS with a VAE, and VAE, with the low level that remembers a window of steps, on a frozen encoder's features: as `lads_history`, with plans that are
vectors."""

from types import SimpleNamespace

import torch
from torch import nn

from ..kinds import history, sighted_history
from ..kinds import vae as kind
from ..model import TrajectoryEncoder, start_weights
from . import base, lads_history, vae
from .base import Exported
from .windows import Windows


class Networks(vae.Networks):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        encoder, sizes = setting.config.encoder, sighted_history.low_level_sizes(setting, encoded)
        width = encoder.observed or setting.observation_len  # it is shown only what it looks at
        self.encoder = TrajectoryEncoder(encoder.hidden, width, setting.action_len, 2 * sizes.plan, width, encoder.relative)
        self.low_level = history.HistoryPolicy(sizes, nn.Linear(sizes.plan, sizes.hidden))
        start_weights(self.low_level)


class Training(Windows, vae.Training):
    STAGES = lads_history.Training.STAGES

    def cloning(self, segments, plans, episodes):
        return self.in_windows(episodes[segments.rows.cpu()], segments.starts, plans)

    def _low_level_loss(self, generator):
        episodes, starts, _ = self.corpus.draw_transitions(self.settings(self.config, "low_level").batch, generator)
        bc = self.in_windows(episodes, starts, vae.sample(self.known[episodes, starts]))
        return self.config.training.bc_weight * bc, {"bc": bc}

    def actions_layer(self):
        return self.networks.low_level.head


@torch.no_grad()
def export(networks, setting, encoded):
    high, low = base.sizes(setting, encoded), sighted_history.low_level_sizes(setting, encoded)
    policy = SimpleNamespace(normalizer=None, high_level=networks.high_level, low_level=networks.low_level)
    base.with_eyes(policy, networks)
    family = kind.family(high, setting.config.system.rule, 0) | {"history": history.recall(low)}
    return Exported(kind.build(policy, high, low), family, noise=[high.plan])
