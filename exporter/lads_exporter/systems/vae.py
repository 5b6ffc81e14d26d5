"""System `vae`, and LADS with a VAE: plans are Gaussian vectors instead of codes, and the high level gives the mean and deviation of one.

The trajectory encoder gives q = N(mu, sigma); the low level learns on a draw from it. Its loss is the squared error plus beta times the mean
divergence per element from N(0, 1); the high level's is the divergence of its Gaussian from q, summed over the elements, with q held fixed (equation 7).
With `alignment.weight` above 0 it is LADS with a VAE. The same stages as LADS'. Log deviations are limited to [-10, 2].
"""

from types import SimpleNamespace

import torch
import torch.nn.functional as F
from torch import nn

from ..kinds import vae
from ..model import Alignment, HighLevelPolicy, LowLevelPolicy, Normalizer, TrajectoryEncoder
from . import base, lads
from .base import Exported

COLLAPSED = 0.05  # nats: an element of the plan with less divergence than this carries next to nothing


class Networks(nn.Module):
    def __init__(self, setting, encoded):
        super().__init__()
        config, o, a = setting.config, setting.observation_len, setting.action_len
        encoder = config.encoder
        dim = encoder.codebook_dim
        self.normalizer = Normalizer(o)
        self.encoder = TrajectoryEncoder(encoder.hidden, o, a, 2 * dim, encoder.observed or o, encoder.relative)
        self.low_level = LowLevelPolicy(config.low_level, o, dim, a)
        self.high_level = HighLevelPolicy(config.high_level, encoded.dim, o, a, 2 * dim)
        self.alignment = Alignment(config.alignment, dim, len(encoded.instructions[0].sentence))


def split(gaussian):
    """Splits [..., 2 D] -> mean [..., D], limited log deviation [..., D]."""
    mean, log_std = gaussian.chunk(2, -1)
    return mean, log_std.clamp(*vae.LOG_STD)


def sample(gaussian):
    mean, log_std = split(gaussian)
    return mean + log_std.exp() * torch.randn_like(mean)


def divergence(q, p):
    """Computes KL(q || p) of each element, [..., D]; both as [..., 2 D], p None for N(0, 1)."""
    mean, log_std = split(q)
    other, other_log = split(p) if p is not None else (0.0, torch.zeros_like(log_std))
    return other_log - log_std + (torch.exp(2 * log_std) + (mean - other).square()) / (2 * torch.exp(2 * other_log)) - 0.5


class Training(lads.Training):
    CODEBOOK = False
    PARTS = {
        "joint": ("encoder", "low_level", "alignment", "high_level"),
        "plans": ("encoder", "low_level", "alignment"),
        "low_level": ("low_level",),
        "high_level": ("high_level",),
    }

    def begin(self, stage):
        """Computes q of all windows, which stays fixed during the stage."""
        if stage in ("low_level", "high_level"):
            self.networks.eval()
            self.known = self._every_window(range(len(self.corpus.lengths)))

    def _every_window(self, episodes):
        width = 2 * self.config.encoder.codebook_dim
        return self.corpus.of_windows(self.encode, episodes, torch.zeros(len(episodes), self.corpus.steps, width))

    @torch.no_grad()
    def encode(self, segments):
        return self.networks.encoder(segments.observations, segments.executed, segments.lengths)

    def plans(self, episodes, offsets):
        """Computes the losses of segments, and q [B, T, 2 D] with marks [B, T] at their starts."""
        segments = self.corpus.segments(episodes, offsets)
        q = self.networks.encoder(segments.observations, segments.executed, segments.lengths)
        plans = sample(q) if self.networks.encoder.training else split(q)[0]
        losses = {"bc": self.cloning(segments, plans, episodes), "kl": divergence(q, None).mean(), "align": self.align(plans, segments, episodes)}
        known = q.new_zeros(len(episodes), self.corpus.steps, q.shape[1])
        marks = torch.full(known.shape[:2], -1, dtype=torch.long, device=known.device)
        known[segments.rows, segments.starts] = q.detach()
        marks[segments.rows, segments.starts] = segments.rows * self.corpus.steps + segments.starts
        return losses, (known, marks)

    def high_level(self, episodes, known, marks):
        """Computes L_h, the divergence of the high level's Gaussian from q where there is a mark, summed over the elements; marks are
        places in known [B * T]."""
        high_level = self.networks.high_level
        words, marks, observations, executed = self.contexts.take(episodes, marks, high_level.training)
        with self.half():
            p = high_level(words, observations, executed)
        return divergence(known.flatten(0, 1)[marks[marks >= 0]], p[marks >= 0]).sum(-1).mean()

    def _decisions(self, marks):
        """Keeps only the marks at multiples of H, if the configuration asks for that."""
        if self.config.training.ce_at == "decisions":
            marks = marks.clone()
            marks[:, torch.arange(marks.shape[1]) % self.corpus.horizon > 0] = -1
        return marks

    def loss(self, stage, step):
        generator = self.generator(stage, step)
        if stage == "low_level":
            return self._low_level_loss(generator)
        if stage == "high_level":
            episodes = self.draw_alike(stage, step)
            ce = self.high_level(episodes, self.known, self._decisions(self.contexts.places(episodes)))
            return ce, {"ce": ce}
        episodes = self.corpus.draw(self.settings(self.config, stage).batch, generator)
        parts, (known, marks) = self.plans(episodes, self.offsets(episodes, generator))
        total = self.config.training.bc_weight * (parts["bc"] + self.config.system.beta * parts["kl"]) + self.config.alignment.weight * parts["align"]
        if stage == "joint":
            if self.config.training.ce_at == "all":
                known = self._every_window(episodes.tolist())
                marks = self.contexts.places(episodes, torch.arange(len(episodes)))
            parts["ce"] = self.high_level(episodes, known, marks)
            total = total + parts["ce"]
        return total, parts

    def _low_level_loss(self, generator):
        episodes, steps, starts = self.corpus.draw_transitions(self.settings(self.config, "low_level").batch, generator)
        plans = sample(self.known[episodes, starts])
        bc = F.mse_loss(self.networks.low_level(self.corpus.shown(episodes, steps), plans), self.corpus.actions[episodes, steps])
        return self.config.training.bc_weight * bc, {"bc": bc}

    def finish(self, stage):
        if stage in ("joint", "low_level"):
            base.gain(self.actions_layer(), self.config.low_level.gain)

    @torch.no_grad()
    def validate(self, stage):
        episodes = self.corpus.validation
        self.networks.eval()
        parts, (known, marks) = self.plans(episodes, torch.zeros(len(episodes), dtype=torch.long))
        out = {"val_bc": float(parts["bc"]), "val_kl": float(parts["kl"])}
        if stage in ("joint", "high_level"):
            out["val_ce"] = float(self.high_level(episodes, known, marks))
        return out

    @torch.no_grad()
    def summary(self):
        """Counts the elements of the plan that carry something over the held-out episodes."""
        self.networks.eval()
        _, (known, marks) = self.plans(self.corpus.validation, torch.zeros(len(self.corpus.validation), dtype=torch.long))
        each = divergence(known[marks >= 0], None).mean(0)
        return {"plan_elements": len(each), "plan_elements_in_use": int((each >= COLLAPSED).sum()), "divergence": float(each.sum())}


def export(networks, setting, encoded):
    sizes = base.sizes(setting, encoded)
    encoder = TrajectoryEncoder(setting.config.encoder.hidden, sizes.observation, sizes.action, sizes.plan, 0, setting.config.encoder.relative)
    state = networks.encoder.state_dict()
    last = f"mlp.{len(networks.encoder.mlp) - 1}"
    encoder.load_state_dict(state | {f"{last}.{part}": state[f"{last}.{part}"][: sizes.plan] for part in ("weight", "bias")})
    encoder.shown.copy_(networks.encoder.shown)
    policy = SimpleNamespace(normalizer=networks.normalizer, high_level=networks.high_level, low_level=networks.low_level, encoder=encoder.eval())
    base.with_eyes(policy, networks)
    family = vae.family(sizes, setting.config.system.rule, 0)
    return Exported(vae.build(policy, sizes), family, noise=[sizes.plan], segment=sizes.horizon)
