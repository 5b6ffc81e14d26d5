"""Quantised regression as a linear head.

The code nearest to p is argmin |p - c_i|^2 = argmax 2 c_i.p - |c_i|^2, which is linear in p; so a head that regresses a plan, a projection
into the codebook's space and the distances to the codes are one linear layer whose outputs are logits. Computed in float64.
"""

import torch
from torch import nn


@torch.no_grad()
def fold(head, project, codes):
    """head Linear(d, k), project Linear(k, D) or None, codes [M, D] -> Linear(d, M): its largest output is the nearest code."""
    weight, bias, codes = head.weight.double(), head.bias.double(), codes.double()
    if project is not None:
        weight, bias = project.weight.double() @ weight, project.weight.double() @ bias + project.bias.double()
    folded = nn.Linear(weight.shape[1], len(codes))
    folded.weight.copy_(2 * codes @ weight)
    folded.bias.copy_(2 * codes @ bias - codes.square().sum(1))
    return folded
