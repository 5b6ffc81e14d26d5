"""Kind `lisa`: one high-level token a step; the low level is a transformer over the steps of the plan in force."""

import torch
from onnx import TensorProto
from torch import nn

from .. import graphs
from ..model import Block, Dropout, Normalizer, start_weights
from . import common

LEVEL = "low_level"


class ChunkPolicy(nn.Module):
    """Low level: a causal transformer over (option, observation, action) of one plan's steps; the action is read at the observation.

    An option is a row of a table; while it is trained `embed_option` is a layer on the plan instead (`systems.lisa`).
    """

    def __init__(self, sizes, embed_option=None):
        super().__init__()
        self.embed_option = embed_option or nn.Embedding(sizes.codes, sizes.hidden)
        self.embed_observation = nn.Linear(sizes.observation, sizes.hidden)
        self.embed_action = nn.Linear(sizes.action, sizes.hidden)
        self.embed_timestep = nn.Embedding(sizes.steps, sizes.hidden)
        self.embed_norm = nn.LayerNorm(sizes.hidden)
        self.drop = Dropout(sizes.dropout)
        self.blocks = nn.ModuleList(Block(sizes.hidden, sizes.heads, sizes.dropout) for _ in range(sizes.low_level_layers))
        self.norm = nn.LayerNorm(sizes.hidden)
        self.head = nn.Linear(sizes.hidden, sizes.action)
        start_weights(self)

    def forward(self, index, start, observations, actions):
        """Computes the actions of the plan `index` from timestep `start`: normalised observations [T, O], actions [T, A] as executed ->
        actions [T, A]."""
        options = self.embed_option.weight[index].expand(1, len(observations), -1)
        return self.chunks(options, torch.tensor([start]), observations[None], actions[None])[0]

    def chunks(self, options, starts, observations, actions):
        """Computes the actions of N plans of H steps: options [N, H, d] embedded, starts [N], observations [N, H, O], actions [N, H, A] ->
        actions [N, H, A]."""
        time = self.embed_timestep(starts[:, None] + torch.arange(options.shape[1], device=starts.device))
        tokens = torch.stack([options + time, self.embed_observation(observations) + time, self.embed_action(actions) + time], 2)
        return self.head(run_blocks(self, tokens.flatten(1, 2)[:, :-1])[:, 1::3]).float()


class Lisa(nn.Module):
    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.codes, actions=False)
        self.low_level = ChunkPolicy(sizes)

    def logits(self, words, observations):
        """Computes the plans' logits: words [L, E], observations [T, O] in raw units -> logits [T, M]."""
        return self.high_level([words], self.normalizer(observations)[None])[0]


def run_blocks(policy, tokens):
    """Runs causal blocks: tokens [N, S, d] before the first norm -> rows [N, S, d] after the last."""
    x = policy.drop(policy.embed_norm(tokens.float()))
    mask = torch.triu(torch.full((1, 1, tokens.shape[1], tokens.shape[1]), -1e9, device=tokens.device), 1).expand(len(tokens), -1, -1, -1)
    for block in policy.blocks:
        x = block(x, mask)
    return policy.norm(x)


def option_token(entry, table, index, time=None):
    """Makes the token of a plan: its row of the table, with the row `time` = (table, index) added."""
    row = entry.op("Gather", [table, index], "option_row", axis=0)
    if time:
        row = entry.op("Add", [row, entry.op("Gather", list(time), "option_time", axis=0)], "option_flat")
    return entry.op("Unsqueeze", [row, entry.integers("axis_one", [1])], "option_token")


def _low_level(graph, policy, normalizer, sizes, first):
    entry = graphs.Entry(graph, f"{LEVEL}/start" if first else f"{LEVEL}/step")
    if not first:
        action = entry.input("previous_action", [1, sizes.action])
    index = entry.input("index", [1], TensorProto.INT64)
    observation = entry.input(graph.observed, [1, sizes.observation])
    timestep = entry.input("timestep", [1], TensorProto.INT64)
    times = entry.weight(f"{LEVEL}.embed_timestep", policy.embed_timestep.weight)
    tokens = []
    if not first:
        before = entry.op("Sub", [timestep, entry.integers("one", [1])], "timestep_before")
        tokens.append(graphs.token(entry, action, policy.embed_action, (times, before), "action", level=LEVEL))
    tokens.append(option_token(entry, entry.weight(f"{LEVEL}.embed_option", policy.embed_option.weight), index, (times, timestep)))
    tokens.append(graphs.observed_token(entry, observation, policy, normalizer, (times, timestep), LEVEL))
    x = entry.op("Concat", tokens, "token_row", axis=1)
    x = entry.layer_norm(x, f"{LEVEL}.embed_norm", policy.embed_norm, "tokens")
    x = graphs.Transformer(entry, policy, len(tokens), cached=True, level=LEVEL).run(x)
    graphs.head(entry, x, policy.head, "action", f"{LEVEL}.head")


def build(policy, sizes):
    graph = common.graph_of(policy, sizes)
    common.select_at_every_token(graph, policy)
    for first in (True, False):
        _low_level(graph, policy.low_level, policy.normalizer, sizes, first)
    return graph.model("lisa")


def family(sizes, decision):
    return {"kind": "lisa", "horizon": sizes.horizon, "codebook": sizes.codebook, "decision": decision, "low_level": sizes.low_level_network}


def contract(sizes, seed):
    return common.contract(family(sizes, common.argmax()), sizes, seed)
