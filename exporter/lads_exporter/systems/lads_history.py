"""LADS with a low level that remembers a window of steps, on a frozen encoder's features: the paper's Kitchen setting with images.

The stages are those of LADS on states; the low level is a causal transformer over the plan, the W steps before it and the H steps under it, and
learns whole plans: those of the segments in `plans`, and of windows that start anywhere in `low_level`. Its batch is of plans, not of steps.
"""

from ..kinds import sighted_history
from . import base, lads
from .base import Exported
from .windows import Windows


def Networks(setting, encoded):
    return sighted_history.Remembering(setting, encoded, lads.head(setting))


class Training(Windows, lads.Training):
    STAGES = {"staged": lads.Training.STAGES["staged"]}

    def cloning(self, segments, plans, episodes):
        return self.in_windows(episodes[segments.rows.cpu()], segments.starts, plans)

    def _low_level_loss(self, generator):
        episodes, starts, _ = self.corpus.draw_transitions(self.settings(self.config, "low_level").batch, generator)
        plans = self.networks.codebook.codes[self.codes[episodes, starts]]
        bc = self.in_windows(episodes, starts, plans)
        return self.config.training.bc_weight * bc, {"bc": bc}

    def actions_layer(self):
        return self.networks.low_level.head


def export(networks, setting, encoded):
    made = sighted_history.graph(lads.acting(networks, setting), setting, encoded)
    return Exported(made, sighted_history.family(setting, encoded, base.decision(setting)))
