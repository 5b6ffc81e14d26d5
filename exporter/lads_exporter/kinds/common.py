"""Shared parts of the policies of every family: sizes and parts of networks; and a made-up bench with instructions for small random ones.

The random ones exist to prove that the runtime runs a family. Invariant: the same kind and seed give the same bundle. Trained policies (`systems`)
fill in `Sizes` from their configuration and take networks and entry graphs from here.
"""

from dataclasses import dataclass

import torch
from torch import nn

from .. import bundle, config, contract as contracts, graphs, language, random_policy
from ..model import HighLevelPolicy

ENVIRONMENT = {
    "id": "random-bench",
    "version": "1",
    "control_period_s": 0.02,
    "quaternion_order": "none",
    "reference": "velocity around the observed joint position",
    "observation": [
        *({"name": f"joint{n}", "unit": "rad", "min": -2.0 - n / 4, "max": 2.0, "joint": f"joint{n}", "interface": "position"} for n in range(1, 5)),
        *({"name": f"joint{n}_velocity", "unit": "rad/s", "min": -8.0, "max": 8.0, "joint": f"joint{n}", "interface": "velocity"} for n in range(1, 4)),
        {"name": "drawer", "unit": "m", "min": -0.1, "max": 0.6, "joint": "drawer", "interface": "position"},
    ],
    "action": [
        {"name": f"joint{n}_velocity", "unit": "1", "min": -1.0, "max": 1.0 - n / 10, "joint": f"joint{n}", "interface": "velocity", "scale": 2.0, "physical_unit": "rad/s"}
        for n in range(1, 4)
    ],
}
INSTRUCTIONS = [
    {"id": "open", "text": "open the drawer slowly", "sub_tasks": ["drawer"], "split": "seen"},
    {"id": "close", "text": "close it", "sub_tasks": ["drawer"], "split": "seen"},
    {"id": "turn", "text": "turn the lever left now", "sub_tasks": ["lever"], "split": "unseen"},
]
WORDS = language.encode(config.Language("random-12", -1, False), [row["text"] for row in INSTRUCTIONS])


@dataclass(frozen=True)
class Sizes:
    """Sizes of the networks, by default the bench's; the names are the configuration's."""

    observation: int = len(ENVIRONMENT["observation"])
    action: int = len(ENVIRONMENT["action"])
    words: language.Encoded = WORDS
    hidden: int = 32
    layers: int = 2
    heads: int = 4
    dropout: float = 0.0
    steps: int = 40
    horizon: int = 4
    codes: int = 6
    plan: int = 5
    window: int = 3
    low_level_layers: int = 2

    @property
    def transformer(self):
        return config.HighLevel(self.hidden, self.layers, self.heads, self.dropout, self.steps, 0.0)

    @property
    def network(self):
        return {"layers": self.layers, "heads": self.heads, "head_dim": self.hidden // self.heads}

    @property
    def low_level_network(self):
        return self.network | {"layers": self.low_level_layers}

    @property
    def codebook(self):
        return {"size": self.codes, "dim": self.plan}


class Codes(nn.Module):
    """Codebook of latent plans [M, D]."""

    def __init__(self, sizes):
        super().__init__()
        self.table = nn.Parameter(torch.zeros(sizes.codes, sizes.plan))


def high_level(sizes, outputs, actions=True):
    """Makes the transformer that reads the words; its head has `outputs` outputs. Without `actions` its history is of observations only."""
    return HighLevelPolicy(sizes.transformer, sizes.words.dim, sizes.observation, sizes.action if actions else None, outputs)


def randomize(policy, seed, placed=True):
    """Sets random weights in all parts of a policy: plans differ from step to step, and few actions are at their limits. What is observed is normalised
    already if not `placed`."""
    generator = torch.Generator().manual_seed(seed)
    random_policy.draw_weights(policy, generator)
    if placed:
        random_policy.place(policy, ENVIRONMENT["observation"], seed)
    with torch.no_grad():
        for module in policy.modules():
            if isinstance(module, nn.Embedding):
                module.weight.copy_(0.3 * torch.randn(module.weight.shape, generator=generator))
            if hasattr(module, "head"):
                module.head.weight.mul_(0.3 if module.head.out_features == len(ENVIRONMENT["action"]) else 2)
    return policy.eval()


def graph_of(policy, sizes):
    """Makes a graph with the table of instructions, the entry that sets one, and the encoder of frames where the policy has one."""
    graph = graphs.Graph()
    graphs.known_instructions(graph, policy.high_level, sizes.words)
    graphs.see(graph, policy)
    return graph


def select_at_every_token(graph, policy):
    """Adds `high_level/step` of a policy whose history is of observations: logits at every step, the first too."""
    entry, x, embedded = graphs.high_level_state(graph, policy.high_level, policy.normalizer)
    graphs.head(entry, x, policy.high_level.head, "logits")
    return entry, embedded


def contract(family, sizes, seed, noise=None, segment=None, image=None, joints=0):
    """Makes the contract of a policy on the bench with instructions."""
    return bundle.describe(
        family,
        ENVIRONMENT,
        INSTRUCTIONS,
        WORDS,
        {"setting": f"random {family['kind']}", "seed": seed},
        channels=contracts.channels(ENVIRONMENT, words=[WORDS.max_words, WORDS.dim], noise=noise, segment=segment, image=image, joints=joints),
        context={"words": WORDS.max_words, "steps": sizes.steps, "beyond": "restart"},
        network=sizes.network,
    )


def argmax(rule="argmax"):
    """Makes the contract's part for a decision by argmax."""
    return {"rule": rule, "temperature": 1.0, "seed": 0}
