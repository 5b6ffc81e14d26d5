"""System `lcsd`, our reading of LCSD: a plan at every step by a quantised high level, and a low level that denoises one action.

Only the abstract of LCSD is public. What is read out of it: two forms of the mutual information of plans and language given the state. I(z; l | s) as
H(z | s) - H(z | s, l): k-means and revival keep the first term up, the second vanishes because the nearest code is taken. And as H(l | s) - H(l | z, s),
which is at least a constant plus E log q(l | z_0 .. z_T): the plans of a whole trajectory have to tell its instruction, whose sentence
embedding a small network reconstructs from them. Trained end to end: squared error of the noise, commitment, squared error of that embedding.
Noise levels, widths and weights are ours. The denoiser that acts is the moving average of the trained one.
"""

import copy

import torch
import torch.nn.functional as F
from torch import nn

from ..config import UserError
from ..kinds import lcsd
from . import base, lisa
from .base import Exported
from .averaging import follow
from ..kinds.denoising import alpha_bar


def shape(setting):
    """Returns the denoiser's sizes."""
    system = setting.config.system
    return lcsd.Denoiser(observed=setting.config.high_level.hidden, time=16, hidden=system.hidden, layers=3, steps=system.steps)


class Networks(lisa.Quantised):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        sizes, hidden = base.sizes(setting, encoded), setting.config.system.hidden
        self.denoiser = lcsd.ActionDenoiser(sizes, shape(setting))
        self.average = copy.deepcopy(self.denoiser).requires_grad_(False)
        sentence = len(encoded.instructions[0].sentence)
        self.reconstruct = nn.Sequential(nn.Linear(sizes.steps * sizes.plan, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, sentence))


class Training(lisa.Training):
    PARTS = ("high_level", "project_in", "codebook", "denoiser", "reconstruct")

    def __init__(self, networks, corpus, setting, seed_of):
        super().__init__(networks, corpus, setting, seed_of)
        if int(corpus.lengths.max()) > setting.config.high_level.context_steps:
            raise UserError("LCSD reconstructs the instruction from the plans of a whole trajectory: high_level.context_steps must not be below the longest one")
        self.bar = torch.from_numpy(alpha_bar(setting.config.system.steps)).float().to(corpus.device)
        self.centre, self.half_width = (torch.from_numpy(side).to(corpus.device) for side in lcsd.box(setting.environment["action"]))

    @property
    def every(self):
        return 1

    def parts_of(self, episodes, levels=None):
        """Computes the losses of all steps of the episodes, and their codes. levels [N]: of the noise, drawn where None."""
        networks, corpus = self.networks, self.corpus
        latents, chunks = self.latents(episodes, 1)
        plans, index, commitment = networks.codebook(latents)
        places = chunks.places[:, 0]
        actions = (corpus.actions.flatten(0, 1)[places] - self.centre) / self.half_width
        eps = torch.randn_like(actions)
        levels = torch.randint(1, len(self.bar), (len(actions),), device=actions.device) if levels is None else levels
        share = self.bar[levels][:, None]
        denoiser = networks.denoiser if networks.denoiser.training else networks.average
        predicted = denoiser(share.sqrt() * actions + (1 - share).sqrt() * eps, chunks.observations[:, 0], plans, levels)
        parts = {"noise": F.mse_loss(predicted, eps), "commitment": commitment, "language": self.language(plans, chunks.kept, episodes)}
        return parts, index

    def language(self, plans, kept, episodes):
        """Computes how far the sentence embedding reconstructed from each trajectory's plans is from the true one, mean per element times
        the elements."""
        sequences = plans.new_zeros(*kept.shape, plans.shape[1])
        sequences[kept] = plans
        rows = F.pad(sequences, (0, 0, 0, self.config.high_level.context_steps - kept.shape[1])).flatten(1)
        sentences = F.normalize(self.corpus.sentences[self.corpus.instruction[episodes].to(plans.device)], dim=-1)
        return (self.networks.reconstruct(rows) - sentences).square().sum(-1).mean()

    def loss(self, stage, step):
        if step == self.config.encoder.kmeans_step:
            self.start_codebook(stage, step, 1)
        parts, index = self.parts_of(self.draw_alike(stage, step))
        total = parts["noise"] + parts["commitment"] + self.config.system.language * parts["language"]
        return total, parts | self.use(index)

    def after(self, stage):
        follow(self.networks.average, self.networks.denoiser, self.config.system.average)

    def finish(self, stage):
        """Applies no gain: what is denoised is not a mean."""

    @torch.no_grad()
    def validate(self, stage):
        self.networks.eval()
        parts, index = self.parts_of(self.held_out())
        return {"val_noise": float(parts["noise"]), "val_perplexity": lisa.perplexity(index, len(self.networks.codebook.codes))}


@torch.no_grad()
def acting(networks, setting, encoded):
    """Returns the policy that acts."""
    policy = lcsd.Lcsd(base.sizes(setting, encoded), shape(setting), setting.environment["action"])
    policy.normalizer.load_state_dict(networks.normalizer.state_dict())
    policy.high_level = networks.folded()
    policy.codes.table.copy_(networks.codebook.codes)
    policy.denoiser.load_state_dict(networks.average.state_dict())
    return policy.eval()


def export(networks, setting, encoded):
    sizes = base.sizes(setting, encoded)
    family = lcsd.family(sizes, base.decision(setting), setting.config.system.steps, 0)
    return Exported(lcsd.build(acting(networks, setting, encoded), sizes), family, noise=[sizes.action])
