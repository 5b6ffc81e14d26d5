"""Kind `lcsd`: a plan at every step, and one action by denoising it with fresh noise at each pass (DDPM)."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from onnx import TensorProto
from torch import nn

from .. import graphs
from ..model import Normalizer
from . import common
from .denoising import Pass, ddpm, dense, mish, passes, sinusoids


@dataclass(frozen=True)
class Denoiser:
    """Sizes of the denoiser, by default the bench's."""

    observed: int = 12  # elements of the embedded observation
    time: int = 16
    hidden: int = 32
    layers: int = 2  # hidden ones
    steps: int = 5


class ActionDenoiser(nn.Module):
    """Network that predicts the noise in an action: an MLP on the action, the observation, the plan and the level."""

    def __init__(self, sizes, shape):
        super().__init__()
        self.shape = shape
        self.register_buffer("sinusoids", torch.from_numpy(sinusoids(range(1, shape.steps + 1), shape.time, 100.0)), persistent=False)
        self.embed_time = nn.Sequential(nn.Linear(shape.time, 2 * shape.time), nn.Mish(), nn.Linear(2 * shape.time, shape.time))
        self.embed_observation = nn.Linear(sizes.observation, shape.observed)
        widths = [sizes.action + shape.observed + sizes.plan + shape.time, *[shape.hidden] * shape.layers]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:]))
        self.last = nn.Linear(shape.hidden, sizes.action)

    def forward(self, x, observations, plans, levels):
        """Predicts the noise: x [N, A], normalised observations [N, O], plans [N, D], levels [N] from 1 -> the noise [N, A]."""
        time = self.embed_time(self.sinusoids)[levels - 1]
        x = torch.cat([x, self.embed_observation(observations), plans, time], -1)
        for layer in self.layers:
            x = F.mish(layer(x))
        return self.last(x)


def box(action):
    """Returns the centre and half width of the action's limits: what a denoised element between -1 and 1 means."""
    low, high = (np.array([row[key] for row in action], np.float32) for key in ("min", "max"))
    return (low + high) / 2, (high - low) / 2


class Lcsd(nn.Module):
    """Policy with a plan at every step and an action by denoising. `action`: the environment's rows."""

    def __init__(self, sizes, shape=Denoiser(), action=common.ENVIRONMENT["action"]):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.codes, actions=False)
        self.codes = common.Codes(sizes)
        self.denoiser = ActionDenoiser(sizes, shape)
        self.centre, self.half = box(action)

    def logits(self, words, observations):
        """Computes the plans' logits: words [L, E], observations [T, O] in raw units -> logits [T, M]."""
        return self.high_level([words], self.normalizer(observations)[None])[0]

    def denoise(self, observation, index, noise):
        """Denoises an action: observation [1, O] in raw units, noise [1 + passes, A] in the order of its use -> action [1, A]."""
        steps = self.denoiser.shape.steps
        tables = {name: torch.from_numpy(table) for name, table in ddpm(steps).items()}
        x = noise[:1]
        for number, level in enumerate(passes("ddpm", steps, steps)):
            eps = self.denoiser(x, self.normalizer(observation), self.codes.table[index][None], torch.tensor([level]))
            row = {name: table[number] for name, table in tables.items()}
            x0 = (row["x_scale"] * x + row["eps_scale"] * eps).clamp(-1, 1)
            x = row["x0_share"] * x0 + row["x_share"] * x + row["deviation"] * noise[1 + number]
        return torch.from_numpy(self.centre) + torch.from_numpy(self.half) * x


def build(policy, sizes):
    graph = common.graph_of(policy, sizes)
    common.select_at_every_token(graph, policy)
    width, net = sizes.action, policy.denoiser
    steps = net.shape.steps
    entry = graphs.Entry(graph, "low_level/init")
    entry.op("Identity", [entry.input("noise", [1, width])], "x")
    entry.output("x", [1, width])

    entry = graphs.Entry(graph, "low_level/denoise")
    x, number = entry.input("x", [1, width]), entry.input("pass", [1], TensorProto.INT64)
    index = entry.input("index", [1], TensorProto.INT64)
    observation, noise = entry.input("observation", [1, sizes.observation]), entry.input("noise", [1, width])
    centred = entry.centred(observation, policy.normalizer, "observation_centred")
    folded = graphs.fold_std(net.embed_observation.weight, policy.normalizer)
    seen = dense(entry, centred, net.embed_observation, "denoiser.embed_observation", "observation_embedded", folded)
    plan = entry.op("Gather", [entry.weight("codebook", policy.codes.table), index], "plan", axis=0)
    with torch.no_grad():
        times = net.embed_time(net.sinusoids).flip(0)
    time = entry.op("Gather", [entry.weight("denoiser.times", times), number], "time", axis=0)
    hidden = entry.op("Concat", [x, seen, plan, time], "joined", axis=1)
    for place, layer in enumerate(net.layers):
        hidden = mish(entry, dense(entry, hidden, layer, f"denoiser.layer.{place}", f"layer.{place}"), f"layer.{place}.mish")
    eps = dense(entry, hidden, net.last, "denoiser.last", "eps")
    share = Pass(entry, "denoiser", ddpm(steps), number)
    x0 = share.sum([(x, "x_scale"), (eps, "eps_scale")], "x0_free")
    x0 = entry.op("Clip", [x0, entry.scalar("minus_one", -1.0), entry.scalar("plus_one", 1.0)], "x0")
    share.sum([(x0, "x0_share"), (x, "x_share"), (noise, "deviation")], "next_x")
    entry.output("next_x", [1, width])

    entry = graphs.Entry(graph, "low_level/act")
    scaled = entry.op("Mul", [entry.input("x", [1, width]), entry.weight("action.half", policy.half)], "scaled")
    entry.op("Add", [scaled, entry.weight("action.centre", policy.centre)], "action")
    entry.output("action", [1, width])
    return graph.model("lcsd")


def family(sizes, decision, steps, seed):
    return {"kind": "lcsd", "codebook": sizes.codebook, "decision": decision, "denoise": {"steps": steps}, "noise": {"rule": "seeded", "seed": seed}}


def contract(sizes, seed):
    found = family(sizes, common.argmax(), Denoiser().steps, seed)
    return common.contract(found, sizes, seed, noise=[sizes.action])
