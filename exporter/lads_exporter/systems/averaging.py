"""Moving average of a network's weights."""

import torch


@torch.no_grad()
def follow(average, network, decay):
    """Moves `average` towards `network`: average = decay average + (1 - decay) network."""
    for slow, fast in zip(average.parameters(), network.parameters(), strict=True):
        slow.lerp_(fast, 1 - decay)
