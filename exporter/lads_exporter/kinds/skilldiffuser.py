"""Kind `skilldiffuser`: every H steps, H + 1 embedded observations by denoising with guidance, and from them the H actions in between.

The first row is the present observation and stays clean. DDIM takes few passes and no noise but the first; DDPM takes every level and noise at each.
"""

import torch
import torch.nn.functional as F
from onnx import TensorProto
from torch import nn

from .. import graphs
from ..model import Normalizer
from . import common
from .denoising import Pass, ddim, ddpm, dense, passes
from .unet import Nodes, Shape, Tables, Unet

GUIDANCE, TEMPERATURE, CLIP = 1.2, 0.5, 3.0


class Sampler:
    """Sampler of the denoised rows: the passes' levels and coefficients."""

    def __init__(self, name="ddim", levels=20, count=4, guidance=GUIDANCE, temperature=TEMPERATURE, clip=CLIP):
        self.name, self.guidance, self.temperature, self.clip = name, guidance, temperature, clip
        self.levels = passes(name, levels, count)
        self.tables = ddim(levels, count) if name == "ddim" else ddpm(levels, temperature)

    def step(self, number, x, eps, noise):
        """Runs a pass on x and eps [L, c] -> the rows after it."""
        row = {name: torch.from_numpy(table[number]) for name, table in self.tables.items()}
        x0 = (row["x_scale"] * x + row["eps_scale"] * eps).clamp(-self.clip, self.clip)
        if self.name == "ddpm":
            return row["x0_share"] * x0 + row["x_share"] * x + row["deviation"] * noise
        return row["x0_share"] * x0 + row["eps_share"] * (x - row["x0_scale"] * x0) * row["eps_back"]

    def nodes(self, entry, x, eps, noise, number):
        share = Pass(entry, "denoiser", self.tables, number)
        x0 = share.sum([(x, "x_scale"), (eps, "eps_scale")], "x0_free")
        x0 = entry.op("Clip", [x0, entry.scalar("clip_low", -self.clip), entry.scalar("clip_high", self.clip)], "x0")
        if self.name == "ddpm":
            return share.sum([(x0, "x0_share"), (x, "x_share"), (noise, "deviation")], "following")
        back = entry.op("Sub", [x, entry.op("Mul", [x0, share.rows["x0_scale"]], "x0_part")], "noise_part")
        back = entry.op("Mul", [back, share.rows["eps_back"]], "eps_again")
        return share.sum([(x0, "x0_share"), (back, "eps_share")], "following")


class InverseDynamics(nn.Module):
    """Network for the action between two embedded observations: three linear layers."""

    def __init__(self, inputs, hidden, action):
        super().__init__()
        self.first, self.second, self.head = nn.Linear(2 * inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, action)

    def forward(self, x):
        """Computes the actions between rows: x [..., L, c] -> actions [..., L - 1, A]."""
        pairs = torch.cat([x[..., :-1, :], x[..., 1:, :]], -1)
        return self.head(F.relu(self.second(F.relu(self.first(pairs)))))


class SkillDiffuser(nn.Module):
    """Policy with a plan every H steps; H + 1 embedded observations by denoising, H actions between them."""

    def __init__(self, sizes, shape=Shape(), hidden=32, sampler=None):
        super().__init__()
        self.sampler = sampler or Sampler()
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.codes, actions=False)
        self.embed = nn.Linear(sizes.observation, shape.inputs)
        self.embed_norm = nn.LayerNorm(shape.inputs)
        self.options = nn.Parameter(torch.zeros(sizes.codes, shape.inputs))
        self.denoiser = Unet(shape)
        self.inverse = InverseDynamics(shape.inputs, hidden, sizes.action)

    def logits(self, words, observations):
        """Computes the plans' logits: words [L, E], observations [T, O] in raw units -> logits [T, M]."""
        return self.high_level([words], self.normalizer(observations)[None])[0]

    def chunk(self, observation, index, noise):
        """Computes a chunk of actions: observation [1, O] in raw units, noise of the first rows and of each pass that draws, flat ->
        actions [H, A]."""
        rows = self.denoiser.shape.rows
        present, draws = self.embed_norm(self.embed(self.normalizer(observation))), noise.view(-1, rows, self.denoiser.shape.inputs)
        x = torch.cat([present, self.sampler.temperature * draws[0, 1:]])
        options = self.options[index].expand(2, -1)
        for number, level in enumerate(self.sampler.levels):
            told = self.denoiser.told(torch.tensor([level, level]), options, torch.tensor([[0.0], [1.0]]))
            free, guided = self.denoiser(x.expand(2, -1, -1), told)
            eps = free + self.sampler.guidance * (guided - free)
            after = self.sampler.step(number, x, eps, draws[1 + number] if len(draws) > 1 else None)
            x = torch.cat([present, after[1:]])
        return self.inverse(x)


def _first_row(entry, present, x, rows, width, out):
    """Replaces the first row of x by `present`."""
    ends = [entry.integers(f"number.{n}", [n]) for n in (1, rows, 0)]
    rest = entry.op("Slice", [x, *ends], out + ".rest")
    entry.op("Concat", [present, rest], out, axis=0)
    entry.output(out, [rows, width])


def _denoise(graph, policy, rows, width):
    net, sampler = policy.denoiser, policy.sampler
    entry = graphs.Entry(graph, "low_level/denoise")
    x, number = entry.input("x", [rows, width]), entry.input("pass", [1], TensorProto.INT64)
    index, present = entry.input("index", [1], TensorProto.INT64), entry.input("embedding", [1, width])
    noise = None
    if sampler.name == "ddpm":
        flat = entry.input("noise", [1, rows * width])
        noise = entry.op("Reshape", [flat, entry.integers(f"shape.{rows}.{width}", [rows, width])], "noise_rows")
    tables = Tables(entry, net, sampler.levels, policy.options, number)
    halves = []
    for prefix, option in (("free", entry.integers("no_option", [len(policy.options)])), ("told", index)):
        tables.choose(prefix, option)
        halves.append(Nodes(entry, net, tables, prefix).run(x))
    apart = entry.op("Sub", [halves[1], halves[0]], "apart")
    eps = entry.op("Add", [halves[0], entry.op("Mul", [apart, entry.scalar("guidance", sampler.guidance)], "guided")], "eps")
    _first_row(entry, present, sampler.nodes(entry, x, eps, noise, number), rows, width, "next_x")


def build(policy, sizes):
    graph = common.graph_of(policy, sizes)
    rows, width = policy.denoiser.shape.rows, policy.denoiser.shape.inputs
    entry, _ = common.select_at_every_token(graph, policy)
    folded = graphs.fold_std(policy.embed.weight, policy.normalizer)
    present = dense(entry, f"{entry.name}/observation_centred", policy.embed, "embed", "embedding_flat", folded)
    entry.layer_norm(present, "embed_norm", policy.embed_norm, "embedding")
    entry.output("embedding", [1, width])

    entry = graphs.Entry(graph, "low_level/init")
    noise, present = entry.input("noise", [1, rows * width]), entry.input("embedding", [1, width])
    shaped = entry.op("Reshape", [noise, entry.integers(f"shape.{rows}.{width}", [rows, width])], "noise_rows")
    scaled = entry.op("Mul", [shaped, entry.scalar("temperature", policy.sampler.temperature)], "scaled")
    _first_row(entry, present, scaled, rows, width, "x")

    _denoise(graph, policy, rows, width)

    entry = graphs.Entry(graph, "low_level/inverse")
    x = entry.input("x", [rows, width])
    ends = [entry.integers(f"number.{n}", [n]) for n in (0, rows - 1, 1, rows)]
    now = entry.op("Slice", [x, ends[0], ends[1], ends[0]], "now")
    then = entry.op("Slice", [x, ends[2], ends[3], ends[0]], "then")
    hidden = entry.op("Concat", [now, then], "pairs", axis=1)
    for name in ("first", "second"):
        hidden = entry.op("Relu", [dense(entry, hidden, getattr(policy.inverse, name), f"inverse.{name}", name)], f"{name}.relu")
    dense(entry, hidden, policy.inverse.head, "inverse.head", "queue")
    entry.output("queue", [rows - 1, sizes.action])

    entry = graphs.Entry(graph, "low_level/pop")
    queue, phase = entry.input("queue", [rows - 1, sizes.action]), entry.input("phase", [1], TensorProto.INT64)
    entry.op("Gather", [queue, phase], "action", axis=0)
    entry.output("action", [1, sizes.action])
    return graph.model("skilldiffuser")


def family(sizes, decision, shape, sampler, seed):
    return {
        "kind": "skilldiffuser",
        "horizon": shape.rows - 1,
        "codebook": sizes.codebook,
        "decision": decision,
        "denoise": {"steps": len(sampler.levels)},
        "noise": {"rule": "seeded", "seed": seed},
    }


def contract(sizes, seed):
    shape = Shape()
    return common.contract(family(sizes, common.argmax(), shape, Sampler(), seed), sizes, seed, noise=[shape.rows * shape.inputs])
