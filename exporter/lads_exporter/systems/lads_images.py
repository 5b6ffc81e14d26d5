"""LADS on frames of a camera: one convolutional encoder for all parts, frozen for what follows it.

Where `images.frames` has steps:
1. `frames`: the encoder alone tells the state that a frame shows, frame by frame, on augmented frames. A deviation: the paper's encoder learns from
   actions and sentences alone, which say little of what there is to see where actions are random.
2. `plans`, 3. `low_level` and 4. `high_level` as of states, on the features of all frames.

Where it has none, the encoder learns in `plans`, end to end; `images.state_weight` adds the first stage's loss there.

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
    @classmethod
    def stages(cls, config):
        return ("frames",) * cls.apart(config) + lads.Training.STAGES["staged"]

    @classmethod
    def settings(cls, config, stage):
        return config.images.frames if stage == "frames" else super().settings(config, stage)

    @staticmethod
    def apart(config):
        """Returns whether the encoder has a stage of its own."""
        return config.images.frames.steps > 0

    def parts(self, stage):
        if stage == "frames":
            return "frames", "state"
        return ("frames", "state") * self.is_live(stage) + super().parts(stage)

    def is_live(self, stage):
        """Returns whether the encoder learns in a stage of plans."""
        return stage == "plans" and not self.apart(self.config)

    def begin(self, stage):
        self.live = self.is_live(stage)
        if stage != "frames" and not self.live:
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
        self.state_loss = self.told(features, episodes[rows], steps)
        table = features.new_zeros(len(episodes), self.corpus.steps, features.shape[1])
        return self.corpus.segments(episodes, offsets, table.index_put((rows, steps), features))

    def told(self, features, episodes, steps):
        """Computes the mean squared error of the states [N, O] that features [N, F] tell."""
        return F.mse_loss(self.networks.state(features), self.corpus.shown_states[episodes, steps])

    def starters(self):
        few = torch.arange(0, len(self.corpus.train), max(1, len(self.corpus.train) // STARTERS))
        return self.corpus.train[few]

    def loss(self, stage, step):
        if stage == "frames":
            batch = self.settings(self.config, stage).batch
            episodes, steps, _ = self.corpus.draw_transitions(batch, self.generator(stage, step))
            frames = augmented(self.corpus.frames_at(episodes, steps), torch.arange(batch), batch, self.config.images)
            loss = self.told(self.networks.frames(frames), episodes, steps)
            return loss, {"state": loss}
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

    @torch.no_grad()
    def validate(self, stage):
        if stage == "frames":
            self.networks.eval()
            frames, rows, steps = self.corpus.seen(self.corpus.validation)
            features = torch.cat([self.networks.frames(part) for part in frames.split(BATCH)])
            return {"val_state": float(self.told(features, self.corpus.validation[rows], steps))}
        out = super().validate(stage)
        return out | {"val_state": float(self.state_loss)} if self.live else out


def export(networks, setting, encoded):
    family = lads.family(setting) | {"features": setting.observation_len}
    return Exported(sighted.graph(networks, encoded), family)
