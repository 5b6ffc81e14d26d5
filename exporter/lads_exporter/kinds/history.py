"""Kind `history`: LISA's high level; the low level is a transformer over the plan, a window of earlier steps and those of the plan.

The window is a ring of tokens before their positions are added: row = [action embedded, observation embedded]. At a decision the low level hears
the plan, then the window's rows at positions 0, 1, ...; a step of the plan stands at position `window` plus its phase.
"""

import copy

import torch
from onnx import TensorProto
from torch import nn

from .. import graphs
from ..model import Block, Dropout
from . import common
from .lisa import Lisa, option_token, run_blocks

LEVEL = "low_level"


class HistoryPolicy(nn.Module):
    """Low level: a causal transformer over the plan, then pairs of (previous action, observation); the action is read at the observation.

    A plan is a row of a table; while it is trained `embed_option` is a layer on the code instead (`systems.lads_history`), and where plans are
    vectors it stays one (`vae_history`).
    """

    def __init__(self, sizes, embed_option=None):
        super().__init__()
        self.window = sizes.window
        self.embed_option = embed_option or nn.Embedding(sizes.codes, sizes.hidden)
        self.embed_observation = nn.Linear(sizes.observation, sizes.hidden)
        self.embed_action = nn.Linear(sizes.action, sizes.hidden)
        self.embed_position = nn.Embedding(sizes.window + sizes.horizon, sizes.hidden)
        self.embed_norm = nn.LayerNorm(sizes.hidden)
        self.drop = Dropout(sizes.dropout)
        self.blocks = nn.ModuleList(Block(sizes.hidden, sizes.heads, sizes.dropout) for _ in range(sizes.low_level_layers))
        self.norm = nn.LayerNorm(sizes.hidden)
        self.head = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, plan, observations, before, previous, steps):
        """Computes actions [steps, A] under a plan, its index or the vector [D]: the last so many `steps` of normalised observations [T, O] are the
        plan's own, `before` rows are its window; previous [T, A] are the actions executed before each observation."""
        pairs = torch.stack([self.embed_action(previous), self.embed_observation(observations)], 1)
        places = torch.cat([torch.arange(before), self.window + torch.arange(steps)])
        pairs = pairs[-(before + steps) :] + self.embed_position.weight[places][:, None]
        tokens = torch.cat([self.embedded(plan)[None], pairs.flatten(0, 1)])
        return self.head(run_blocks(self, tokens[None])[0][2 + 2 * before :: 2])

    def embedded(self, plan):
        return self.embed_option(plan) if self.embeds else self.embed_option.weight[plan]

    @property
    def embeds(self):
        """Whether a plan is a vector, which a layer embeds."""
        return isinstance(self.embed_option, nn.Linear)

    @torch.no_grad()
    def with_table(self, options):
        """Returns the policy that acts: with a table of embedded options [M, ...] in place of the layer that embeds them."""
        acting = copy.deepcopy(self)
        rows = self.embed_option(options)
        acting.embed_option = nn.Embedding(*rows.shape).requires_grad_(False)
        acting.embed_option.weight.copy_(rows)
        return acting.eval()

    def chunks(self, options, observations, previous, before):
        """Computes the actions of N plans of H steps: options [N, d] embedded, observations [N, W + H, O] and previous [N, W + H, A], of which
        the first W rows are the window and the first `before` [N] of those valid -> actions [N, H, A]."""
        count, rows = observations.shape[:2]
        pairs = torch.stack([self.embed_action(previous), self.embed_observation(observations)], 2)
        pairs = pairs + self.embed_position.weight[:rows, None]
        x = self.drop(self.embed_norm(torch.cat([options[:, None], pairs.flatten(1, 2)], 1).float()))
        place = torch.arange(x.shape[1], device=x.device)
        number = (place - 1) // 2  # of the pair; -1 is the plan
        hidden = (number >= before[:, None]) & (number < self.window)
        mask = torch.where(hidden[:, None] | (place > place[:, None]), -1e9, 0.0)[:, None]
        for block in self.blocks[:-1]:
            x = block(x, mask)
        return self.head(self.norm(self.blocks[-1](x, mask, slice(2 + 2 * self.window, None, 2)))).float()


class History(Lisa):
    def __init__(self, sizes):
        super().__init__(sizes)
        self.low_level = HistoryPolicy(sizes)


def _transformer(entry, policy, x, new, record_only=False):
    x = entry.layer_norm(x, f"{LEVEL}.embed_norm", policy.embed_norm, "tokens")
    return graphs.Transformer(entry, policy, new, cached=True, level=LEVEL).run(x, record_only)


def _plan(graph, policy):
    entry = graphs.Entry(graph, f"{LEVEL}/plan")
    if policy.embeds:
        plan, weights = entry.input("plan", [1, policy.embed_option.in_features]), f"{LEVEL}.embed_option"
        row = entry.gemm(plan, entry.weight(f"{weights}.weight", policy.embed_option.weight), entry.weight(f"{weights}.bias", policy.embed_option.bias), "option_row")
        x = entry.op("Unsqueeze", [row, entry.integers("axis_one", [1])], "option_token")
    else:
        index = entry.input("index", [1], TensorProto.INT64)
        x = option_token(entry, entry.weight(f"{LEVEL}.embed_option", policy.embed_option.weight), index)
    _transformer(entry, policy, x, 1, record_only=True)


def _recall(graph, policy, sizes):
    entry = graphs.Entry(graph, f"{LEVEL}/recall")
    row, number = entry.input("row", [1, 2 * sizes.hidden]), entry.input("pass", [1], TensorProto.INT64)
    pair = entry.op("Reshape", [row, entry.integers("row_tokens", [1, 2, sizes.hidden])], "row_tokens")
    place = entry.op("Gather", [entry.weight(f"{LEVEL}.embed_position", policy.embed_position.weight), number], "position", axis=0)
    x = entry.op("Add", [pair, place], "row_placed")
    _transformer(entry, policy, x, 2, record_only=True)


def _step(graph, policy, normalizer, sizes):
    entry = graphs.Entry(graph, f"{LEVEL}/step")
    action, observation = entry.input("previous_action", [1, sizes.action]), entry.input(graph.observed, [1, sizes.observation])
    phase = entry.input("phase", [1], TensorProto.INT64)
    place = entry.op("Add", [phase, entry.integers("window", [sizes.window])], "place")
    positions = entry.weight(f"{LEVEL}.embed_position", policy.embed_position.weight)
    tokens = [
        graphs.token(entry, action, policy.embed_action, (positions, place), "action", level=LEVEL),
        graphs.observed_token(entry, observation, policy, normalizer, (positions, place), LEVEL),
    ]
    x = _transformer(entry, policy, entry.op("Concat", tokens, "token_pair", axis=1), 2)
    graphs.head(entry, x, policy.head, "action", f"{LEVEL}.head")


def _append(graph, policy, normalizer, sizes):
    entry = graphs.Entry(graph, "memory/append")
    action, observation = entry.input("previous_action", [1, sizes.action]), entry.input(graph.observed, [1, sizes.observation])
    observation, folded = graphs.raw(entry, observation, policy.embed_observation, normalizer)
    rows, parts = [], (("action", action, policy.embed_action, policy.embed_action.weight), ("observation", observation, policy.embed_observation, folded))
    for name, x, module, weight in parts:
        label = f"{LEVEL}.embed_{name}"
        rows.append(entry.gemm(x, entry.weight(label + ".weight", weight), entry.weight(label + ".bias", module.bias), f"{name}_embedded"))
    entry.op("Concat", rows, "next_row", axis=1)
    entry.output("next_row", [1, 2 * sizes.hidden])


def add_low_level(graph, policy, normalizer, sizes):
    """Adds the low level's entries."""
    _plan(graph, policy)
    _recall(graph, policy, sizes)
    _step(graph, policy, normalizer, sizes)
    _append(graph, policy, normalizer, sizes)


def build(policy, sizes, low_level_sizes=None):
    """Builds all entries; the low level has sizes of its own where they are given."""
    graph = common.graph_of(policy, sizes)
    common.select_at_every_token(graph, policy)
    add_low_level(graph, policy.low_level, policy.normalizer, low_level_sizes or sizes)
    return graph.model("history")


def recall(sizes):
    """Makes what the contract says of the low level."""
    return {"window": sizes.window, "memory": {"dim": 2 * sizes.hidden}, "low_level": sizes.low_level_network}


def family(sizes, decision):
    return {"kind": "history", "horizon": sizes.horizon, "codebook": sizes.codebook, "decision": decision, **recall(sizes)}


def contract(sizes, seed):
    return common.contract(family(sizes, common.argmax()), sizes, seed)
