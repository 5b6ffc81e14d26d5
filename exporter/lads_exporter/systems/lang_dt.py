"""System `lang_dt`: a causal transformer over words, observations and actions that gives the action itself, in every step; no plan, no low
level.

Trained end to end by the mean squared error over whole trajectories.
"""

import torch
import torch.nn.functional as F
from torch import nn

from ..kinds import common, lang_dt
from ..model import Normalizer
from . import base
from .base import Exported


class Networks(nn.Module):
    def __init__(self, setting, encoded):
        super().__init__()
        sizes = base.sizes(setting, encoded)
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.action)


class Training(base.Training):
    def parts(self, stage):
        return ("high_level",)

    def actions(self, episodes):
        """Computes the mean squared error of the actions over all steps of the episodes."""
        high_level = self.networks.high_level
        words, places, observations, executed = self.contexts.take(episodes, self.contexts.places(episodes), high_level.training)
        with self.half():
            out = high_level(words, observations, executed)
        valid = places >= 0
        return F.mse_loss(out[valid], self.corpus.actions.flatten(0, 1)[places[valid]])

    def loss(self, stage, step):
        bc = self.actions(self.draw_alike(stage, step))
        return self.config.training.bc_weight * bc, {"bc": bc}

    def finish(self, stage):
        base.gain(self.networks.high_level.head, self.config.low_level.gain)

    @torch.no_grad()
    def validate(self, stage):
        self.networks.eval()
        return {"val_bc": float(self.actions(self.held_out()))}


def export(networks, setting, encoded):
    return Exported(lang_dt.build(networks, base.sizes(setting, encoded)), {"kind": "lang_dt"})
