"""Systems on frames of a camera: one convolutional encoder for all of a system's parts, frozen for what follows it.

Where `images.frames` has steps, the encoder learns in a stage of its own, `frames`, before those that the system has on states: it tells the state
that a frame shows, frame by frame, on augmented frames. A deviation: the paper's encoders learn from actions and sentences alone, which say little of
what there is to see where actions are random; and the paper has an encoder for each part, where sharing a frozen one halves weights and work of a
control step. The encoder starts from the same weights in every system, so all of them end up with the same one.

Where it has none, the encoder learns in LADS' stage `plans`, end to end; `images.state_weight` adds the first stage's loss there.
"""

from functools import cache
from types import SimpleNamespace

import torch
import torch.nn.functional as F

from ..frames import BATCH, augmented
from ..kinds import sighted
from . import lads
from .base import Exported

FRAMES = "frames"
STARTERS = 256  # episodes whose segments start the codebook


class Seeing:
    """What a system's training has beside that on states: put before it among the bases of a class."""

    @classmethod
    def stages(cls, config):
        return (FRAMES,) * cls.apart(config) + super().stages(config)

    @classmethod
    def settings(cls, config, stage):
        return config.images.frames if stage == FRAMES else super().settings(config, stage)

    @staticmethod
    def apart(config):
        """Returns whether the encoder has a stage of its own."""
        return config.images.frames.steps > 0

    def parts(self, stage):
        return ("frames", "state") if stage == FRAMES else super().parts(stage)

    def begin(self, stage):
        if stage == FRAMES:
            return
        self.freeze()
        super().begin(stage)

    def freeze(self):
        """Computes the features of all frames, which stay as they are from here on."""
        self.networks.eval()
        self.corpus.freeze(self.networks.frames)

    def told(self, features, episodes, steps):
        """Computes the mean squared error of the states [N, O] that features [N, F] tell."""
        return F.mse_loss(self.networks.state(features), self.corpus.shown_states[episodes, steps])

    def loss(self, stage, step):
        if stage != FRAMES:
            return super().loss(stage, step)
        batch = self.settings(self.config, stage).batch
        episodes, steps, _ = self.corpus.draw_transitions(batch, self.generator(stage, step))
        frames = augmented(self.corpus.frames_at(episodes, steps), torch.arange(batch), batch, self.config.images)
        loss = self.told(self.networks.frames(frames), episodes, steps)
        return loss, {"state": loss}

    def finish(self, stage):
        if stage != FRAMES:
            super().finish(stage)

    @torch.no_grad()
    def validate(self, stage):
        if stage != FRAMES:
            return super().validate(stage)
        self.networks.eval()
        frames, rows, steps = self.corpus.seen(self.corpus.validation)
        features = torch.cat([self.networks.frames(part) for part in frames.split(BATCH)])
        return {"val_state": float(self.told(features, self.corpus.validation[rows], steps))}

    def summary(self):
        # A finished run that is resumed begins no stage.
        self.freeze()
        return super().summary()


class Lads(Seeing, lads.Training):
    """Training of LADS, whose encoder may learn in the stage `plans` instead, end to end."""

    def is_live(self, stage):
        """Returns whether the encoder learns in a stage of plans."""
        return stage == "plans" and not self.apart(self.config)

    def parts(self, stage):
        return ("frames", "state") * self.is_live(stage) + super().parts(stage)

    def begin(self, stage):
        self.live = self.is_live(stage)
        super().begin(stage)

    def freeze(self):
        if not self.live:
            super().freeze()

    def segments(self, episodes, offsets):
        """Returns the segments; while the encoder learns, those of features that it computes anew."""
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

    def starters(self):
        few = torch.arange(0, len(self.corpus.train), max(1, len(self.corpus.train) // STARTERS))
        return self.corpus.train[few]

    def loss(self, stage, step):
        total, parts = super().loss(stage, step)
        if self.is_live(stage):
            parts["state"] = self.state_loss
            total = total + self.config.images.state_weight * self.state_loss
        return total, parts

    @torch.no_grad()
    def validate(self, stage):
        out = super().validate(stage)
        return out | {"val_state": float(self.state_loss)} if self.is_live(stage) else out

    def summary(self):
        self.live = False
        return super().summary()


@cache
def of(system):
    """Makes the module of a system on frames from that of the system on states."""

    def networks(setting, encoded):
        return sighted.give_eyes(system.Networks(setting, encoded), setting, encoded)

    def export(networks, setting, encoded):
        made = system.export(networks, setting, encoded)
        return Exported(made.model, made.family | {"features": setting.observation_len}, made.noise)

    training = Lads if system is lads else type("Training", (Seeing, system.Training), {})
    return SimpleNamespace(Networks=networks, Training=training, export=export)
