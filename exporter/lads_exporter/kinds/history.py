"""Kind `history`: LISA's high level; the low level is a transformer over the plan, a window of earlier steps and those of the plan.

The window is a ring of tokens before their positions are added: row = [action embedded, observation embedded]. At a decision the low level hears
the plan, then the window's rows at positions 0, 1, ...; a step of the plan stands at position `window` plus its phase.
"""

import torch
from onnx import TensorProto
from torch import nn

from .. import graphs
from ..model import Block, Dropout
from . import common
from .lisa import Lisa, option_token, run_blocks

LEVEL = "low_level"


class HistoryPolicy(nn.Module):
    def __init__(self, sizes):
        super().__init__()
        self.window = sizes.window
        self.embed_option = nn.Embedding(sizes.codes, sizes.hidden)
        self.embed_observation = nn.Linear(sizes.observation, sizes.hidden)
        self.embed_action = nn.Linear(sizes.action, sizes.hidden)
        self.embed_position = nn.Embedding(sizes.window + sizes.horizon, sizes.hidden)
        self.embed_norm = nn.LayerNorm(sizes.hidden)
        self.drop = Dropout(0.0)
        self.blocks = nn.ModuleList(Block(sizes.hidden, sizes.heads, 0.0) for _ in range(sizes.low_level_layers))
        self.norm = nn.LayerNorm(sizes.hidden)
        self.head = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, index, observations, before, previous, steps):
        """Computes actions [steps, A]: the last so many `steps` of normalised observations [T, O] are the plan's own, `before` rows are its
        window; previous [T, A] are the actions executed before each observation."""
        pairs = torch.stack([self.embed_action(previous), self.embed_observation(observations)], 1)
        places = torch.cat([torch.arange(before), self.window + torch.arange(steps)])
        pairs = pairs[-(before + steps) :] + self.embed_position.weight[places][:, None]
        tokens = torch.cat([self.embed_option.weight[index][None], pairs.flatten(0, 1)])
        return self.head(run_blocks(self, tokens[None])[0][2 + 2 * before :: 2])


class History(Lisa):
    def __init__(self, sizes):
        super().__init__(sizes)
        self.low_level = HistoryPolicy(sizes)


def _transformer(entry, policy, x, new, record_only=False):
    x = entry.layer_norm(x, f"{LEVEL}.embed_norm", policy.embed_norm, "tokens")
    return graphs.Transformer(entry, policy, new, cached=True, level=LEVEL).run(x, record_only)


def _plan(graph, policy):
    entry = graphs.Entry(graph, f"{LEVEL}/plan")
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
    action, observation = entry.input("previous_action", [1, sizes.action]), entry.input("observation", [1, sizes.observation])
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
    action, observation = entry.input("previous_action", [1, sizes.action]), entry.input("observation", [1, sizes.observation])
    centred = entry.centred(observation, normalizer, "observation_centred")
    rows = []
    for name, x, module in (("action", action, policy.embed_action), ("observation", centred, policy.embed_observation)):
        weight = module.weight if name == "action" else graphs.fold_std(module.weight, normalizer)
        label = f"{LEVEL}.embed_{name}"
        rows.append(entry.gemm(x, entry.weight(label + ".weight", weight), entry.weight(label + ".bias", module.bias), f"{name}_embedded"))
    entry.op("Concat", rows, "next_row", axis=1)
    entry.output("next_row", [1, 2 * sizes.hidden])


def build(policy, sizes):
    graph = common.graph_of(policy, sizes)
    common.select_at_every_token(graph, policy)
    _plan(graph, policy.low_level)
    _recall(graph, policy.low_level, sizes)
    _step(graph, policy.low_level, policy.normalizer, sizes)
    _append(graph, policy.low_level, policy.normalizer, sizes)
    return graph.model("history")


def contract(sizes, seed):
    family = {
        "kind": "history",
        "horizon": sizes.horizon,
        "codebook": sizes.codebook,
        "decision": common.argmax(),
        "window": sizes.window,
        "memory": {"dim": 2 * sizes.hidden},
        "low_level": sizes.low_level_network,
    }
    return common.contract(family, sizes, seed)
