"""The vector-quantised codebook: nearest code (equation 4), moving-average codes, commitment (equation 6).

The moving average takes the place of the codebook term of equation 6. The codes start by k-means++ on
encoded segments, and a code that is hardly used is replaced by a random latent of the batch, so that the
whole codebook stays in use.
"""

import torch
import torch.nn.functional as F
from torch import nn


def nearest(latents, codes):
    """Finds the nearest code by squared distance: latents [N, D], codes [M, D] -> index [N]."""
    return (latents[:, None] - codes[None]).square().sum(-1).argmin(-1)


def kmeans(points, count, iterations=25):
    """Runs k-means with k-means++ seeding: points [N, D] -> centres [count, D], members [count]."""
    centres = points[torch.randint(len(points), (1,))]
    for _ in range(count - 1):
        distance = torch.cdist(points, centres).min(1).values.square() + 1e-8
        centres = torch.cat([centres, points[torch.multinomial(distance, 1)]])
    for _ in range(iterations):
        index = nearest(points, centres)
        members = torch.bincount(index, minlength=count).to(points.dtype)
        sums = torch.zeros_like(centres).index_add_(0, index, points)
        centres = torch.where(members[:, None] > 0, sums / members.clamp(min=1)[:, None], centres)
    return centres, torch.bincount(nearest(points, centres), minlength=count).to(points.dtype)


class Codebook(nn.Module):
    """Codebook of M codes of D elements. Until `start` was called, latents pass through unquantised."""

    def __init__(self, config):
        super().__init__()
        size, dim = config.codebook_size, config.codebook_dim
        self.commitment, self.ema, self.revive_below = config.commitment, config.ema, config.revive_below
        self.register_buffer("codes", torch.randn(size, dim))
        self.register_buffer("uses", torch.ones(size))
        self.register_buffer("sums", torch.zeros(size, dim))
        self.register_buffer("started", torch.tensor(False))
        self.register_buffer("revived", torch.tensor(0))

    @torch.no_grad()
    def start(self, latents):
        """Places the codes by k-means++ on latents [N, D]."""
        centres, members = kmeans(latents, len(self.codes))
        self.codes.copy_(centres)
        self.uses.copy_(members.clamp(min=1))
        self.sums.copy_(centres * self.uses[:, None])
        self.started.fill_(True)

    @torch.no_grad()
    def _update(self, latents, index):
        counts = torch.bincount(index, minlength=len(self.codes)).to(latents.dtype)
        sums = torch.zeros_like(self.sums).index_add_(0, index, latents)
        self.uses.lerp_(counts, 1 - self.ema)
        self.sums.lerp_(sums, 1 - self.ema)
        self.codes.copy_(self.sums / self.uses.clamp(min=1e-5)[:, None])
        mean_use = self.uses.mean()
        dead = self.uses < self.revive_below * mean_use
        if dead.any():
            chosen = latents[torch.randint(len(latents), (int(dead.sum()),), device=latents.device)]
            self.codes[dead] = chosen
            self.uses[dead] = 0.5 * mean_use
            self.sums[dead] = chosen * 0.5 * mean_use
            self.revived += int(dead.sum())

    def forward(self, latents):
        """Quantises latents [N, D] -> plans [N, D] (straight-through), index [N], commitment loss (beta included)."""
        if not self.started:
            return latents, torch.zeros(len(latents), dtype=torch.long, device=latents.device), latents.new_zeros(())
        index = nearest(latents.detach(), self.codes)
        if self.training:
            self._update(latents.detach(), index)
        plans = self.codes[index]
        return latents + (plans - latents).detach(), index, self.commitment * F.mse_loss(latents, plans)


def perplexity(index, size):
    """Computes exp of the entropy of the use of the codes: `size` when all are used alike, 1 when one dominates."""
    share = torch.bincount(index.flatten(), minlength=size).double()
    share = share / share.sum()
    return float(torch.exp(-(share * share.clamp(min=1e-12).log()).sum()))
