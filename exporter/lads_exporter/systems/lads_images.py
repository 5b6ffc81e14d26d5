"""LADS on frames of a camera: one convolutional encoder for all parts, trained with the plans and frozen for what follows.

1. `plans`: encoder of frames, trajectory encoder, codebook, low level and semantic regularisation, on augmented frames; where
   `images.state_weight` is not 0, the features also tell the state that a frame shows (an addition: random actions say little of what
   there is to see);
2. `low_level` and 3. `high_level` as of states, on the features of all frames.

The paper has an encoder for each part; sharing a frozen one is a deviation that halves weights and work of a control step.
"""

import torch
import torch.nn.functional as F
from torch import nn

from .. import graphs
from ..frames import FrameEncoder, augmented
from ..model import Lads
from . import lads
from .base import Exported

STARTERS = 256  # episodes whose segments start the codebook
ENTRY = "observation_encoder/encode"


class Networks(Lads):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        self.frames = FrameEncoder(setting.config.images, setting.rendering["size"])
        self.state = nn.Linear(setting.observation_len, setting.state_len)


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
        """In the first stage, of features that the encoder gives now."""
        if not self.live:
            return super().segments(episodes, offsets)
        frames, rows, steps = self.corpus.seen(episodes)
        encoder = self.networks.frames
        if encoder.training:
            frames = augmented(frames, rows, len(episodes), self.config.images)
        features = encoder(frames)
        shown = self.corpus.states_seen[episodes[rows], steps]
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

    def validate(self, stage):
        out = super().validate(stage)
        return out | {"val_state": float(self.state_loss)} if self.live else out


def export(networks, setting, encoded):
    graph, name = graphs.Graph(), "features"
    graphs.known_instructions(graph, networks.high_level, encoded)
    networks.frames.build(graphs.Entry(graph, ENTRY))
    for first in (True, False):
        graphs.high_level_step(graph, networks.high_level, networks.normalizer, first, observed=name)
    graphs.codebook_lookup(graph, graphs.to_numpy(networks.codebook.codes))
    graphs.low_level_act(graph, networks.low_level, networks.normalizer, observed=name)
    return Exported(graph.model("lads"), lads.family(setting) | {"features": setting.observation_len})
