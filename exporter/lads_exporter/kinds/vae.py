"""Kind `vae`: the high level gives the mean and the deviation of a continuous plan, the low level is an MLP on observation and plan.

`vae_history` has the low level of `history` instead."""

import torch
from torch import nn

from .. import config, graphs
from ..model import LowLevelPolicy, Normalizer, TrajectoryEncoder
from . import common, history

LOG_STD = (-10.0, 2.0)


class Vae(nn.Module):
    """Policy of a high level with a Gaussian head, a low level, and the trajectory encoder's mean."""

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, 2 * sizes.plan)
        low_level = config.LowLevel(sizes.hidden, 4, 0.2, 1.0)
        self.low_level = LowLevelPolicy(low_level, sizes.observation, sizes.plan, sizes.action)
        self.encoder = TrajectoryEncoder(16, sizes.observation, sizes.action, sizes.plan, sizes.observation, False)

    def plans(self, words, observations, actions):
        """Computes the plans' distribution: words [L, E], observations [T, O] in raw units, actions [T, A] as executed -> mean and log
        deviation [T, D]."""
        mean, log_std = self.high_level([words], self.normalizer(observations)[None], actions[None])[0].chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD)

    def act(self, observations, plans):
        return self.low_level(self.normalizer(observations), plans)


def _half(module, part):
    """Takes half of a linear layer's outputs as a layer of its own."""
    rows = module.out_features // 2
    half = nn.Linear(module.in_features, rows)
    pick = slice(part * rows, (part + 1) * rows)
    with torch.no_grad():
        half.weight.copy_(module.weight[pick])
        half.bias.copy_(module.bias[pick])
    return half


def _sample(graph, dim):
    entry = graphs.Entry(graph, "plan/sample")
    mean, log_std, noise = (entry.input(name, [1, dim]) for name in ("plan_mean", "plan_log_std", "noise"))
    scaled = entry.op("Mul", [entry.op("Exp", [log_std], "std"), noise], "scaled_noise")
    entry.op("Add", [mean, scaled], "plan")
    entry.output("plan", [1, dim])


def build(policy, sizes, low_level_sizes=None):
    """Builds all entries; with sizes of its own the low level is one that remembers, and the trajectory encoder, which reads features that
    nobody outside has, is left out."""
    graph = common.graph_of(policy, sizes)
    mean, log_std = (_half(policy.high_level.head, part) for part in (0, 1))
    for first in (True, False):
        entry, x, _ = graphs.high_level_state(graph, policy.high_level, policy.normalizer, first, "action")
        graphs.head(entry, x, mean, "plan_mean", "high_level.plan_mean")
        wide = entry.gemm(x, entry.weight("high_level.plan_log_std.weight", log_std.weight), entry.weight("high_level.plan_log_std.bias", log_std.bias), "log_std")
        low, high = (entry.scalar(f"log_std_{name}", value) for name, value in zip(("low", "high"), LOG_STD))
        entry.op("Clip", [wide, low, high], "plan_log_std")
        entry.output("plan_log_std", [1, sizes.plan])
    _sample(graph, sizes.plan)
    if low_level_sizes:
        history.add_low_level(graph, policy.low_level, policy.normalizer, low_level_sizes)
    else:
        graphs.low_level_act(graph, policy.low_level, policy.normalizer)
        graphs.trajectory_encode(graph, policy.encoder, None, policy.normalizer, sizes.horizon)
    return graph.model("vae")


class VaeHistory(Vae):
    """The same with a low level that attends to a window of earlier steps."""

    def __init__(self, sizes):
        super().__init__(sizes)
        self.low_level = history.HistoryPolicy(sizes, nn.Linear(sizes.plan, sizes.hidden))


def build_history(policy, sizes):
    return build(policy, sizes, sizes)


def family(sizes, rule, seed):
    return {"kind": "vae", "horizon": sizes.horizon, "plan": {"dim": sizes.plan}, "decision": {"rule": rule, "seed": seed}}


def family_history(sizes, rule, seed):
    return family(sizes, rule, seed) | {"history": history.recall(sizes)}


def contract_history(sizes, seed):
    return common.contract(family_history(sizes, "sample", seed), sizes, seed, noise=[sizes.plan])


def contract(sizes, seed):
    return common.contract(family(sizes, "sample", seed), sizes, seed, noise=[sizes.plan], segment=sizes.horizon)
