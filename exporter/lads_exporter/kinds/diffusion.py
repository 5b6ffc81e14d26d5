"""`lcsd` and `skilldiffuser`: low levels that denoise.

`lcsd` denoises one action at every step (DDPM, fresh noise at each pass); `skilldiffuser` denoises the observations to come, embedded, once a plan
(DDIM with guidance) and an inverse model reads the actions between them. What depends on the pass number alone is a table.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from onnx import TensorProto
from torch import nn

from .. import graphs
from . import common

TIME = 16
GUIDANCE, TEMPERATURE, CLIP = 1.2, 0.5, 3.0


def alpha_bar(steps):
    """The cosine schedule at 0 to `steps`, [steps + 1]; the last one is kept off zero."""
    f = lambda u: math.cos(math.pi / 2 * (u + 0.008) / 1.008) ** 2
    return np.clip([f(k / steps) / f(0) for k in range(steps + 1)], 0.05, 1.0)


def times(steps):
    """Sinusoids of the passes, [steps, TIME]; pass 0 is the noisiest."""
    rate = np.exp(-np.log(100.0) * np.arange(TIME // 2) / (TIME // 2 - 1))
    angle = np.arange(steps, 0, -1)[:, None] * rate
    return np.concatenate([np.sin(angle), np.cos(angle)], 1).astype(np.float32)


def _columns(rows):
    return {name: np.array(values, np.float32)[:, None] for name, values in rows.items()}


def ddpm(steps):
    """Coefficients of each pass: x0 = x_scale x + eps_scale eps; next = x0_share x0 + x_share x + deviation noise."""
    bar = alpha_bar(steps)
    rows = {"x_scale": [], "eps_scale": [], "x0_share": [], "x_share": [], "deviation": []}
    for k in range(steps, 0, -1):
        beta = 1 - bar[k] / bar[k - 1]
        rows["x_scale"].append(bar[k] ** -0.5)
        rows["eps_scale"].append(-(((1 - bar[k]) / bar[k]) ** 0.5))
        rows["x0_share"].append(bar[k - 1] ** 0.5 * beta / (1 - bar[k]))
        rows["x_share"].append((1 - bar[k - 1]) * (1 - beta) ** 0.5 / (1 - bar[k]))
        rows["deviation"].append((beta * (1 - bar[k - 1]) / (1 - bar[k])) ** 0.5)
    return _columns(rows)


def ddim(steps):
    """Coefficients of each pass: x0 = x_scale x + eps_scale eps; eps' = (x - x0_scale x0) eps_back; next = x0_share x0 + eps_share eps'."""
    bar = alpha_bar(steps)
    rows = {"x_scale": [], "eps_scale": [], "x0_scale": [], "eps_back": [], "x0_share": [], "eps_share": []}
    for k in range(steps, 0, -1):
        rows["x_scale"].append(bar[k] ** -0.5)
        rows["eps_scale"].append(-(((1 - bar[k]) / bar[k]) ** 0.5))
        rows["x0_scale"].append(bar[k] ** 0.5)
        rows["eps_back"].append((1 - bar[k]) ** -0.5)
        rows["x0_share"].append(bar[k - 1] ** 0.5)
        rows["eps_share"].append((1 - bar[k - 1]) ** 0.5)
    return _columns(rows)


def mish(entry, x, out):
    """x tanh(softplus x) = x n / (n + 2), n = e^x (e^x + 2); above 20 it is x."""
    power = entry.op("Exp", [entry.op("Min", [x, entry.scalar("twenty", 20.0)], out + ".low")], out + ".exp")
    two = entry.scalar("two", 2.0)
    n = entry.op("Mul", [power, entry.op("Add", [power, two], out + ".plus")], out + ".n")
    share = entry.op("Div", [n, entry.op("Add", [n, two], out + ".over")], out + ".share")
    return entry.op("Mul", [x, share], out)


class Pass:
    """The coefficients of the pass that an entry runs, and sums of products with them."""

    def __init__(self, entry, name, tables, number):
        self.entry = entry
        self.rows = {key: entry.op("Gather", [entry.weight(f"{name}.{key}", table), number], key, axis=0) for key, table in tables.items()}

    def sum(self, terms, out):
        """[(value, coefficient), ...] -> their sum."""
        products = [self.entry.op("Mul", [value, self.rows[key]], f"{out}.{place}") for place, (value, key) in enumerate(terms)]
        total = products[0]
        for place, product in enumerate(products[1:], 1):
            total = self.entry.op("Add", [total, product], out if place == len(products) - 1 else f"{out}.sum{place}")
        return total


def _dense(entry, x, module, name, out, weight=None):
    weight = entry.weight(f"{name}.weight", module.weight if weight is None else weight)
    return entry.gemm(x, weight, entry.weight(f"{name}.bias", module.bias), out)


class ActionDenoiser(nn.Module):
    """The noise in an action: an MLP on the action, the observation, the plan and the pass."""

    def __init__(self, sizes):
        super().__init__()
        self.embed_observation = nn.Linear(sizes.observation, 12)
        self.first = nn.Linear(sizes.action + 12 + sizes.plan + TIME, sizes.hidden)
        self.second = nn.Linear(sizes.hidden, sizes.hidden)
        self.last = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, x, observation, plan, time):
        joined = torch.cat([x, self.embed_observation(observation), plan, time], -1)
        return self.last(F.mish(self.second(F.mish(self.first(joined)))))


class Lcsd(nn.Module):
    """A plan at every step, an action by denoising."""

    STEPS = 5

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = common.normalizer()
        self.high_level = common.high_level(sizes, sizes.codes, actions=False)
        self.codes = common.Codes(sizes)
        self.denoiser = ActionDenoiser(sizes)
        action = common.ENVIRONMENT["action"]
        low, high = (np.array([row[key] for row in action], np.float32) for key in ("min", "max"))
        self.centre, self.half = (low + high) / 2, (high - low) / 2

    def logits(self, words, observations):
        """words [L, E], observations [T, O] in raw units -> logits [T, M]."""
        return self.high_level([words], self.normalizer(observations)[None])[0]

    def denoise(self, observation, index, noise):
        """observation [1, O] in raw units, noise [1 + STEPS, A] in the order of its use -> action [1, A]."""
        tables = {name: torch.from_numpy(table) for name, table in ddpm(self.STEPS).items()}
        x = noise[:1]
        for k, time in enumerate(torch.from_numpy(times(self.STEPS))):
            eps = self.denoiser(x, self.normalizer(observation), self.codes.table[index][None], time[None])
            row = {name: table[k] for name, table in tables.items()}
            x0 = (row["x_scale"] * x + row["eps_scale"] * eps).clamp(-1, 1)
            x = row["x0_share"] * x0 + row["x_share"] * x + row["deviation"] * noise[1 + k]
        return torch.from_numpy(self.centre) + torch.from_numpy(self.half) * x


def build_lcsd(policy, sizes):
    graph = common.graph_of(policy)
    common.select_at_every_token(graph, policy)
    width, net = sizes.action, policy.denoiser
    entry = graphs.Entry(graph, "low_level/init")
    entry.op("Identity", [entry.input("noise", [1, width])], "x")
    entry.output("x", [1, width])

    entry = graphs.Entry(graph, "low_level/denoise")
    x, number = entry.input("x", [1, width]), entry.input("pass", [1], TensorProto.INT64)
    index = entry.input("index", [1], TensorProto.INT64)
    observation, noise = entry.input("observation", [1, sizes.observation]), entry.input("noise", [1, width])
    centred = entry.centred(observation, policy.normalizer, "observation_centred")
    folded = graphs.fold_std(net.embed_observation.weight, policy.normalizer)
    seen = _dense(entry, centred, net.embed_observation, "denoiser.embed_observation", "observation_embedded", folded)
    plan = entry.op("Gather", [entry.weight("codebook", policy.codes.table), index], "plan", axis=0)
    time = entry.op("Gather", [entry.weight("denoiser.times", times(policy.STEPS)), number], "time", axis=0)
    joined = entry.op("Concat", [x, seen, plan, time], "joined", axis=1)
    hidden = mish(entry, _dense(entry, joined, net.first, "denoiser.first", "first"), "first.mish")
    hidden = mish(entry, _dense(entry, hidden, net.second, "denoiser.second", "second"), "second.mish")
    eps = _dense(entry, hidden, net.last, "denoiser.last", "eps")
    share = Pass(entry, "denoiser", ddpm(policy.STEPS), number)
    x0 = share.sum([(x, "x_scale"), (eps, "eps_scale")], "x0_free")
    x0 = entry.op("Clip", [x0, entry.scalar("minus_one", -1.0), entry.scalar("plus_one", 1.0)], "x0")
    share.sum([(x0, "x0_share"), (x, "x_share"), (noise, "deviation")], "next_x")
    entry.output("next_x", [1, width])

    entry = graphs.Entry(graph, "low_level/act")
    scaled = entry.op("Mul", [entry.input("x", [1, width]), entry.weight("action.half", policy.half)], "scaled")
    entry.op("Add", [scaled, entry.weight("action.centre", policy.centre)], "action")
    entry.output("action", [1, width])
    return graph.model("lcsd")


def contract_lcsd(sizes, seed):
    family = {
        "kind": "lcsd",
        "codebook": sizes.codebook,
        "decision": common.argmax(),
        "denoise": {"steps": Lcsd.STEPS},
        "noise": {"rule": "seeded", "seed": seed},
    }
    return common.contract(family, sizes, seed, noise=[sizes.action])


class Residual(nn.Module):
    """Two convolutions over rows with group norm and Mish, the pass and the option added in between, and the input."""

    GROUPS = 4

    def __init__(self, inputs, outputs, embedded):
        super().__init__()
        self.first, self.second = nn.Linear(3 * inputs, outputs), nn.Linear(3 * outputs, outputs)
        self.embed = nn.Linear(embedded, outputs)
        self.norm1, self.norm2 = nn.GroupNorm(self.GROUPS, outputs), nn.GroupNorm(self.GROUPS, outputs)
        self.skip = nn.Linear(inputs, outputs) if inputs != outputs else None

    def forward(self, x, embedded):
        """x [L, inputs], embedded [1, E] -> [L, outputs]."""
        group = lambda norm, rows: norm(rows.T[None])[0].T
        y = F.mish(group(self.norm1, self.first(neighbours(x)))) + self.embed(F.mish(embedded))
        y = F.mish(group(self.norm2, self.second(neighbours(y))))
        return y + (x if self.skip is None else self.skip(x))


def neighbours(x):
    """Each row beside the one before and the one after it, zeros beyond the ends: [L, c] -> [L, 3c]."""
    nothing = x.new_zeros(1, x.shape[1])
    return torch.cat([torch.cat([nothing, x[:-1]]), x, torch.cat([x[1:], nothing])], 1)


class StateDenoiser(nn.Module):
    """The noise in rows of embedded observations: a U-Net of one halving."""

    def __init__(self, sizes, width):
        super().__init__()
        self.options = nn.Parameter(torch.zeros(sizes.codes + 1, 16))  # the last one is of no option
        self.down = Residual(width, 16, TIME + 16)
        self.halve = nn.Linear(3 * 16, 16)
        self.middle = Residual(16, 32, TIME + 16)
        self.widen = nn.Linear(3 * 32, 16)
        self.up = Residual(32, 16, TIME + 16)
        self.last = nn.Linear(16, width)

    def forward(self, x, option, time):
        """x [L, width], time [1, TIME] -> [L, width]."""
        embedded = torch.cat([time, self.options[option][None]], 1)
        fine = self.down(x, embedded)
        coarse = self.middle(self.halve(neighbours(fine)[::2]), embedded)
        back = self.widen(neighbours(coarse.repeat_interleave(2, 0)))
        return self.last(self.up(torch.cat([fine, back], 1), embedded))


class SkillDiffuser(nn.Module):
    """A plan every H steps; H + 1 embedded observations by denoising, H actions between them."""

    STEPS, WIDTH = 4, 16

    def __init__(self, sizes):
        super().__init__()
        self.rows = sizes.horizon + 1
        self.normalizer = common.normalizer()
        self.high_level = common.high_level(sizes, sizes.codes, actions=False)
        self.embed = nn.Linear(sizes.observation, self.WIDTH)
        self.embed_norm = nn.LayerNorm(self.WIDTH)
        self.denoiser = StateDenoiser(sizes, self.WIDTH)
        self.inverse_first = nn.Linear(2 * self.WIDTH, sizes.hidden)
        self.inverse_last = nn.Linear(sizes.hidden, sizes.action)

    def logits(self, words, observations):
        """words [L, E], observations [T, O] in raw units -> logits [T, M]."""
        return self.high_level([words], self.normalizer(observations)[None])[0]

    def chunk(self, observation, index, noise):
        """observation [1, O] in raw units, noise [rows * WIDTH] -> actions [H, A]."""
        present = self.embed_norm(self.embed(self.normalizer(observation)))
        tables = {name: torch.from_numpy(table) for name, table in ddim(self.STEPS).items()}
        x = torch.cat([present, TEMPERATURE * noise.view(self.rows, -1)[1:]])
        for k, time in enumerate(torch.from_numpy(times(self.STEPS))):
            free, told = (self.denoiser(x, option, time[None]) for option in (len(self.denoiser.options) - 1, index))
            eps = free + GUIDANCE * (told - free)
            row = {name: table[k] for name, table in tables.items()}
            x0 = (row["x_scale"] * x + row["eps_scale"] * eps).clamp(-CLIP, CLIP)
            back = (x - row["x0_scale"] * x0) * row["eps_back"]
            x = torch.cat([present, (row["x0_share"] * x0 + row["eps_share"] * back)[1:]])
        return self.inverse_last(F.relu(self.inverse_first(torch.cat([x[:-1], x[1:]], 1))))


class _Unet:
    """The nodes of a `StateDenoiser`; names of values start with `prefix`."""

    def __init__(self, entry, net, prefix):
        self.entry, self.net, self.prefix = entry, net, prefix

    def run(self, x, embedded, rows):
        entry, net, prefix = self.entry, self.net, self.prefix
        active = mish(entry, embedded, f"{prefix}.embedded.mish")
        fine = self.residual(x, active, net.down, "down", rows)
        seen = self.neighbours(fine, 16, rows, "halve")
        half = entry.op("Gather", [seen, entry.integers("even_rows", list(range(0, rows, 2)))], f"{prefix}.halve.even", axis=0)
        coarse = _dense(entry, half, net.halve, "denoiser.halve", f"{prefix}.halve")
        coarse = self.residual(coarse, active, net.middle, "middle", rows // 2)
        twice = [row // 2 for row in range(rows)]
        wide = entry.op("Gather", [coarse, entry.integers("each_row_twice", twice)], f"{prefix}.widen.rows", axis=0)
        back = _dense(entry, self.neighbours(wide, 32, rows, "widen"), net.widen, "denoiser.widen", f"{prefix}.widen")
        joined = entry.op("Concat", [fine, back], f"{prefix}.joined", axis=1)
        return _dense(entry, self.residual(joined, active, net.up, "up", rows), net.last, "denoiser.last", f"{prefix}.eps")

    def neighbours(self, x, width, rows, name):
        """[rows, width] -> [rows, 3 width]; see the function of that name."""
        entry, out = self.entry, f"{self.prefix}.{name}"
        nothing = entry.graph.constant(f"constants/zeros.{width}", np.zeros((1, width), np.float32))
        ends = [entry.integers(f"number.{n}", [n]) for n in (0, rows - 1, 1, rows)]
        before = entry.op("Slice", [x, ends[0], ends[1], ends[0]], out + ".but_last")
        after = entry.op("Slice", [x, ends[2], ends[3], ends[0]], out + ".but_first")
        before = entry.op("Concat", [nothing, before], out + ".before", axis=0)
        after = entry.op("Concat", [after, nothing], out + ".after", axis=0)
        return entry.op("Concat", [before, x, after], out + ".neighbours", axis=1)

    def residual(self, x, active, module, name, rows):
        entry, out, label = self.entry, f"{self.prefix}.{name}", f"denoiser.{name}"
        inputs, outputs = module.first.in_features // 3, module.first.out_features
        y = _dense(entry, self.neighbours(x, inputs, rows, name + ".first"), module.first, label + ".first", out + ".first")
        y = mish(entry, self.group_norm(y, module.norm1, rows, outputs, name + ".norm1"), out + ".norm1.mish")
        y = entry.op("Add", [y, _dense(entry, active, module.embed, label + ".embed", out + ".embed")], out + ".told")
        y = _dense(entry, self.neighbours(y, outputs, rows, name + ".second"), module.second, label + ".second", out + ".second")
        y = mish(entry, self.group_norm(y, module.norm2, rows, outputs, name + ".norm2"), out + ".norm2.mish")
        if module.skip is not None:
            x = _dense(entry, x, module.skip, label + ".skip", out + ".skip")
        return entry.op("Add", [y, x], out + ".out")

    def group_norm(self, x, module, rows, width, name):
        """Normalises each group of columns over all rows: a layer norm of [groups, rows * columns]."""
        entry, out, groups = self.entry, f"{self.prefix}.{name}", module.num_groups
        columns = width // groups
        shape = lambda *sizes: entry.integers("shape." + ".".join(map(str, sizes)), sizes)
        parts = entry.op("Reshape", [x, shape(rows, groups, columns)], out + ".parts")
        turned = entry.op("Transpose", [parts], out + ".turned", perm=[1, 0, 2])
        flat = entry.op("Reshape", [turned, shape(groups, rows * columns)], out + ".flat")
        ones = entry.graph.constant(f"constants/ones.{rows * columns}", np.ones(rows * columns, np.float32))
        normed = entry.op("LayerNormalization", [flat, ones], out + ".normed", axis=-1, epsilon=module.eps)
        back = entry.op("Reshape", [normed, shape(groups, rows, columns)], out + ".back")
        turned = entry.op("Transpose", [back], out + ".back_turned", perm=[1, 0, 2])
        rows_again = entry.op("Reshape", [turned, shape(rows, width)], out + ".rows")
        label = f"denoiser.{name}"
        scaled = entry.op("Mul", [rows_again, entry.weight(label + ".scale", module.weight)], out + ".scaled")
        return entry.op("Add", [scaled, entry.weight(label + ".bias", module.bias)], out)


def _first_row(entry, present, x, rows, out):
    """x with `present` in its first row."""
    ends = [entry.integers(f"number.{n}", [n]) for n in (1, rows, 0)]
    rest = entry.op("Slice", [x, *ends], out + ".rest")
    entry.op("Concat", [present, rest], out, axis=0)
    entry.output(out, [rows, SkillDiffuser.WIDTH])


def _denoise(graph, policy, rows):
    net, width = policy.denoiser, policy.WIDTH
    entry = graphs.Entry(graph, "low_level/denoise")
    x, number = entry.input("x", [rows, width]), entry.input("pass", [1], TensorProto.INT64)
    index, present = entry.input("index", [1], TensorProto.INT64), entry.input("embedding", [1, width])
    time = entry.op("Gather", [entry.weight("denoiser.times", times(policy.STEPS)), number], "time", axis=0)
    options = entry.weight("denoiser.options", net.options)
    halves = []
    for prefix, option in (("free", entry.integers("no_option", [len(net.options) - 1])), ("told", index)):
        row = entry.op("Gather", [options, option], f"{prefix}.option", axis=0)
        embedded = entry.op("Concat", [time, row], f"{prefix}.embedded", axis=1)
        halves.append(_Unet(entry, net, prefix).run(x, embedded, rows))
    apart = entry.op("Sub", [halves[1], halves[0]], "apart")
    eps = entry.op("Add", [halves[0], entry.op("Mul", [apart, entry.scalar("guidance", GUIDANCE)], "guided")], "eps")
    share = Pass(entry, "denoiser", ddim(policy.STEPS), number)
    x0 = share.sum([(x, "x_scale"), (eps, "eps_scale")], "x0_free")
    x0 = entry.op("Clip", [x0, entry.scalar("clip_low", -CLIP), entry.scalar("clip_high", CLIP)], "x0")
    back = entry.op("Sub", [x, entry.op("Mul", [x0, share.rows["x0_scale"]], "x0_part")], "noise_part")
    back = entry.op("Mul", [back, share.rows["eps_back"]], "eps_again")
    following = share.sum([(x0, "x0_share"), (back, "eps_share")], "following")
    _first_row(entry, present, following, rows, "next_x")


def build_skilldiffuser(policy, sizes):
    graph = common.graph_of(policy)
    width, rows = policy.WIDTH, policy.rows
    entry, _ = common.select_at_every_token(graph, policy)
    folded = graphs.fold_std(policy.embed.weight, policy.normalizer)
    present = _dense(entry, f"{entry.name}/observation_centred", policy.embed, "embed", "embedding_flat", folded)
    entry.layer_norm(present, "embed_norm", policy.embed_norm, "embedding")
    entry.output("embedding", [1, width])

    entry = graphs.Entry(graph, "low_level/init")
    noise, present = entry.input("noise", [1, rows * width]), entry.input("embedding", [1, width])
    shaped = entry.op("Reshape", [noise, entry.integers(f"shape.{rows}.{width}", [rows, width])], "noise_rows")
    _first_row(entry, present, entry.op("Mul", [shaped, entry.scalar("temperature", TEMPERATURE)], "scaled"), rows, "x")

    _denoise(graph, policy, rows)

    entry = graphs.Entry(graph, "low_level/inverse")
    x = entry.input("x", [rows, width])
    ends = [entry.integers(f"number.{n}", [n]) for n in (0, rows - 1, 1, rows)]
    now = entry.op("Slice", [x, ends[0], ends[1], ends[0]], "now")
    then = entry.op("Slice", [x, ends[2], ends[3], ends[0]], "then")
    hidden = _dense(entry, entry.op("Concat", [now, then], "pairs", axis=1), policy.inverse_first, "inverse.first", "first")
    _dense(entry, entry.op("Relu", [hidden], "first.relu"), policy.inverse_last, "inverse.last", "queue")
    entry.output("queue", [rows - 1, sizes.action])

    entry = graphs.Entry(graph, "low_level/pop")
    queue, phase = entry.input("queue", [rows - 1, sizes.action]), entry.input("phase", [1], TensorProto.INT64)
    entry.op("Gather", [queue, phase], "action", axis=0)
    entry.output("action", [1, sizes.action])
    return graph.model("skilldiffuser")


def contract_skilldiffuser(sizes, seed):
    family = {
        "kind": "skilldiffuser",
        "horizon": sizes.horizon,
        "codebook": sizes.codebook,
        "decision": common.argmax(),
        "denoise": {"steps": SkillDiffuser.STEPS},
        "noise": {"rule": "seeded", "seed": seed},
    }
    return common.contract(family, sizes, seed, noise=[(sizes.horizon + 1) * SkillDiffuser.WIDTH])
