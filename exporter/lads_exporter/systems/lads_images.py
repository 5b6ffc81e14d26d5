"""LADS on frames of a camera: one convolutional encoder for all parts, trained with the plans and frozen for what follows.

1. `plans`: encoder of frames, trajectory encoder, codebook, low level and semantic regularisation, on augmented frames; where
   `images.state_weight` is not 0, the features also tell the state that a frame shows (an addition: random actions say little of what
   there is to see);
2. `low_level` and 3. `high_level` as of states, on the features of all frames.

The paper has an encoder for each part; sharing a frozen one is a deviation that halves weights and work of a control step.
"""

import torch
import torch.nn.functional as F

from ..frames import BATCH, augmented
from ..kinds import sighted
from . import lads
from .base import Exported

STARTERS = 256  # episodes whose segments start the codebook
Networks = sighted.Sighted


class Training(lads.Training):
    STAGES = {"staged": lads.Training.STAGES["staged"]}
    PARTS = lads.Training.PARTS | {"plans": ("frames", "state", *lads.Training.PARTS["plans"])}

    def begin(self, stage):
        self.live = stage == "plans"
        if not self.live:
            self.networks.eval()
            self.corpus.freeze(self.networks.frames)
        super().begin(stage)

    def segments(self, episodes, offsets):
        """Returns the segments; in the first stage those of features that the encoder computes anew."""
        if not self.live:
            return super().segments(episodes, offsets)
        frames, rows, steps = self.corpus.seen(episodes)
        encoder = self.networks.frames
        if encoder.training:
            features = encoder(augmented(frames, rows, len(episodes), self.config.images))
        else:  # all that is held out, at once
            features = torch.cat([encoder(part) for part in frames.split(BATCH)])
        shown = self.corpus.shown_states[episodes[rows], steps]
        self.state_loss = F.mse_loss(self.networks.state(features), shown)
        table = features.new_zeros(len(episodes), self.corpus.steps, features.shape[1])
        return self.corpus.segments(episodes, offsets, table.index_put((rows, steps), features))

    def starters(self):
        few = torch.arange(0, len(self.corpus.train), max(1, len(self.corpus.train) // STARTERS))
        return self.corpus.train[few]

    def loss(self, stage, step):
        total, parts = super().loss(stage, step)
        if self.live:
            parts["state"] = self.state_loss
            total = total + self.config.images.state_weight * self.state_loss
        return total, parts

    def summary(self):
        # A finished run that is resumed begins no stage.
        self.networks.eval()
        self.corpus.freeze(self.networks.frames)
        return super().summary()

    def validate(self, stage):
        out = super().validate(stage)
        return out | {"val_state": float(self.state_loss)} if self.live else out


def export(networks, setting, encoded):
    family = lads.family(setting) | {"features": setting.observation_len}
    return Exported(sighted.graph(networks, encoded), family)
