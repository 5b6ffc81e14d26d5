"""LADS with a low level that remembers a window of steps, on a frozen encoder's features: the paper's Kitchen setting with images.

The stages are those of LADS on states; the low level is a causal transformer over the plan, the W steps before it and the H steps under it, and
learns whole plans: those of the segments in `plans`, and of windows that start anywhere in `low_level`. Its batch is of plans, not of steps.
"""

import torch
import torch.nn.functional as F

from ..kinds import sighted_history
from . import base, lads
from .base import Exported


def Networks(setting, encoded):
    return sighted_history.Remembering(setting, encoded, lads.head(setting))


class Training(lads.Training):
    STAGES = {"staged": lads.Training.STAGES["staged"]}

    def cloning(self, segments, plans, episodes):
        return self.chunks(episodes[segments.rows.cpu()], segments.starts, plans)

    def chunks(self, episodes, starts, plans):
        """Computes the mean squared error of the actions of whole plans: episodes [N], starts [N], plans [N, D] (equation 5)."""
        corpus, low_level = self.corpus, self.networks.low_level
        episodes, starts = (x.to(corpus.device)[:, None] for x in (episodes, starts))
        before = starts.clamp(max=low_level.window)
        # The window's rows begin at its first valid one, as the runtime has them; those behind its last are hidden.
        window = starts - before + torch.arange(low_level.window, device=corpus.device)
        steps = torch.cat([window, starts + torch.arange(corpus.horizon, device=corpus.device)], 1)
        previous = corpus.executed[episodes, (steps - 1).clamp(min=0)] * (steps > 0)[..., None]
        with self.half():
            options = low_level.embed_option(plans)
            actions = low_level.chunks(options, corpus.shown(episodes, steps), previous, before[:, 0])
        own = steps[:, low_level.window :]
        valid = own < corpus.lengths.to(corpus.device)[episodes]
        return F.mse_loss(actions[valid], corpus.actions[episodes, own][valid])

    def _low_level_loss(self, generator):
        episodes, starts, _ = self.corpus.draw_transitions(self.settings(self.config, "low_level").batch, generator)
        plans = self.networks.codebook.codes[self.codes[episodes, starts]]
        bc = self.chunks(episodes, starts, plans)
        return self.config.training.bc_weight * bc, {"bc": bc}

    def actions_layer(self):
        return self.networks.low_level.head


def export(networks, setting, encoded):
    made = sighted_history.graph(lads.acting(networks, setting), setting, encoded)
    return Exported(made, sighted_history.family(setting, encoded, base.decision(setting)))
