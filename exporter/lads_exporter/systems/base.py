"""Base of every system's training: stages, the settings of each, draws of episodes; and the result of an export."""

from dataclasses import dataclass

import torch

from ..contexts import Contexts
from ..kinds.common import Sizes


HELD_OUT = 512  # episodes that losses of whole contexts are validated on


@dataclass(frozen=True)
class Exported:
    """Entry graphs of a policy, and what its contract says beyond the setting."""

    model: object  # ONNX, without metadata
    family: dict
    noise: list | None = None  # the shape of one draw
    segment: int | None = None  # control steps that the trajectory encoder reads


def sizes(setting, encoded):
    """Returns the sizes of a system's networks, from its configuration."""
    config = setting.config
    high, encoder = config.high_level, config.encoder
    return Sizes(
        observation=setting.observation_len,
        action=setting.action_len,
        words=encoded,
        hidden=high.hidden,
        layers=high.layers,
        heads=high.heads,
        dropout=high.dropout,
        steps=high.context_steps,
        horizon=encoder.horizon,
        codes=encoder.codebook_size,
        plan=encoder.codebook_dim,
        low_level_layers=getattr(config.system, "low_level_layers", 0),
    )


def with_eyes(policy, networks):
    """Hands the encoder of frames, where there is one, to the policy that acts; returns that."""
    if hasattr(networks, "frames"):
        policy.frames = networks.frames
    return policy


def decision(setting):
    """Returns how a plan is picked from logits, for the contract."""
    return {"rule": setting.config.decision, "temperature": 1.0, "seed": 0}


class Training:
    """Training of a system's networks. A subclass says its stages, which parts each trains, and each one's loss.

    Everything random is drawn from PyTorch's generator, which the trainer seeds for every step, or from generators of `seed_of`.
    """

    STAGES = {"joint": ("joint",), "staged": ("joint",)}
    CODEBOOK = False  # whether `perplexity` and `codebook_size` mean something

    def __init__(self, networks, corpus, setting, seed_of):
        self.networks, self.corpus, self.config, self.seed_of = networks, corpus, setting.config, seed_of
        self.contexts = Contexts(corpus, setting)
        self.autocast = setting.config.training.bf16 and _fast_bfloat16(corpus.device)

    @classmethod
    def stages(cls, config):
        """Names of the stages, in their order."""
        return cls.STAGES[config.training.schedule]

    @classmethod
    def settings(cls, config, stage):
        """Returns steps, batch and learning rate of a stage. What is trained end to end takes those of the high level where the schedule is
        staged."""
        own = getattr(config.system, stage, None)
        if own is not None:
            return own
        if stage == "joint" and config.training.schedule == "staged":
            return config.training.high_level
        return getattr(config.training, stage)

    def parts(self, stage):
        """Returns the names of the networks that a stage trains."""
        raise NotImplementedError

    def begin(self, stage):
        """Prepares a stage before its first step, and again where it is resumed."""

    def loss(self, stage, step):
        """Computes the total loss of a step, and its parts by name."""
        raise NotImplementedError

    def after(self, stage):
        """Called after the optimiser's step."""

    def finish(self, stage):
        """Called after a stage's last step: corrections that go into the weights."""

    def validate(self, stage):
        """Computes numbers on the held-out episodes, by name; networks are put into evaluation."""
        return {}

    def summary(self):
        """Returns what a run's summary says beyond steps and seconds."""
        return {}

    def generator(self, stage, draw):
        return torch.Generator().manual_seed(self.seed_of(stage, "draw", draw))

    def draw_alike(self, stage, step):
        """Draws training episodes of similar length for a step."""
        batch = self.settings(self.config, stage).batch
        return self.corpus.draw_alike(batch, step, lambda draw: self.generator(stage, draw))

    def held_out(self):
        """Returns episodes for validation, no more than fit a batch."""
        return self.corpus.validation[:HELD_OUT]

    def half(self):
        """Context in which the transformers run in bfloat16."""
        return torch.autocast(self.corpus.device.type, torch.bfloat16, enabled=self.autocast)


@torch.no_grad()
def gain(linear, factor):
    """Multiplies a linear layer by a gain: the mean of random actions is small even where their direction is clear, and a policy that
    follows it is slow."""
    linear.weight.mul_(factor)
    linear.bias.mul_(factor)


def _fast_bfloat16(device):
    return device.type == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported()
