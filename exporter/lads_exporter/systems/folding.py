"""Folds quantised regression into a linear head.

The code nearest to p is argmin |p - c_i|^2 = argmax 2 c_i.p - |c_i|^2, which is linear in p; so a head that regresses a plan, a projection
into the codebook's space and the distances to the codes are one linear layer whose outputs are logits. Their unit is the codes' mean squared
distance from their centre, so that a margin means the same for every codebook. Computed in float64.
"""

import torch
from torch import nn


@torch.no_grad()
def fold(head, project, codes):
    """Folds a head: head Linear(d, k), project Linear(k, D) or None, codes [M, D] -> Linear(d, M): its largest output is the nearest
    code."""
    weight, bias, codes = head.weight.double(), head.bias.double(), codes.double()
    if project is not None:
        weight, bias = project.weight.double() @ weight, project.weight.double() @ bias + project.bias.double()
    unit = (codes - codes.mean(0)).square().sum(1).mean().clamp(min=1e-12)
    folded = nn.Linear(weight.shape[1], len(codes))
    folded.weight.copy_(2 * codes @ weight / unit)
    folded.bias.copy_((2 * codes @ bias - codes.square().sum(1)) / unit)
    return folded
