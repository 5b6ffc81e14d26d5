"""Shared parts of low levels that denoise: the noise schedule, the coefficients of each pass as tables, and nodes.

Noise levels are numbered 1 to N, 0 is clean; a pass goes from one level to the next lower one of its list. What depends on the pass alone is a table
with a row for each pass, the noisiest first.
"""

import math

import numpy as np

LARGEST_BETA = 0.999


def alpha_bar(levels):
    """Computes the cosine schedule at levels 0 to `levels`, [levels + 1]: how much of the signal's variance is left."""
    f = lambda u: math.cos(math.pi / 2 * (u + 0.008) / 1.008) ** 2
    betas = [min(1 - f(k / levels) / f((k - 1) / levels), LARGEST_BETA) for k in range(1, levels + 1)]
    return np.cumprod([1.0, *(1 - beta for beta in betas)])


def sinusoids(levels, width, base=1e4):
    """Computes sine and cosine of the noise level as the network gets it, level - 1: [len(levels), width]."""
    rate = np.exp(-np.log(base) * np.arange(width // 2) / (width // 2 - 1))
    angle = (np.asarray(levels)[:, None] - 1) * rate
    return np.concatenate([np.sin(angle), np.cos(angle)], 1).astype(np.float32)


def passes(sampler, levels, count):
    """Returns the levels that a sampler's passes start from, the noisiest first: all of them, or `count` that avoid both ends.

    At the noisiest level hardly any signal is left, so what is read off there is noise times thousands.
    """
    if sampler == "ddpm":
        return list(range(levels, 0, -1))
    return [round(level) for level in np.linspace(0.955 * levels, 0.1 * levels, count)]


def _columns(rows):
    return {name: np.array(values, np.float32)[:, None] for name, values in rows.items()}


def ddpm(levels, temperature=1.0):
    """Computes DDPM's coefficients of each pass: x0 = x_scale x + eps_scale eps; next = x0_share x0 + x_share x + deviation noise."""
    bar = alpha_bar(levels)
    rows = {"x_scale": [], "eps_scale": [], "x0_share": [], "x_share": [], "deviation": []}
    for k in passes("ddpm", levels, levels):
        beta = 1 - bar[k] / bar[k - 1]
        rows["x_scale"].append(bar[k] ** -0.5)
        rows["eps_scale"].append(-(((1 - bar[k]) / bar[k]) ** 0.5))
        rows["x0_share"].append(bar[k - 1] ** 0.5 * beta / (1 - bar[k]))
        rows["x_share"].append((1 - bar[k - 1]) * (1 - beta) ** 0.5 / (1 - bar[k]))
        rows["deviation"].append(temperature * (beta * (1 - bar[k - 1]) / (1 - bar[k])) ** 0.5)
    return _columns(rows)


def ddim(levels, count):
    """Computes DDIM's coefficients of each pass: x0 = x_scale x + eps_scale eps; eps' = (x - x0_scale x0) eps_back; next = x0_share x0 +
    eps_share eps'."""
    bar, steps = alpha_bar(levels), passes("ddim", levels, count)
    rows = {"x_scale": [], "eps_scale": [], "x0_scale": [], "eps_back": [], "x0_share": [], "eps_share": []}
    for k, after in zip(steps, [*steps[1:], 0]):
        rows["x_scale"].append(bar[k] ** -0.5)
        rows["eps_scale"].append(-(((1 - bar[k]) / bar[k]) ** 0.5))
        rows["x0_scale"].append(bar[k] ** 0.5)
        rows["eps_back"].append((1 - bar[k]) ** -0.5)
        rows["x0_share"].append(bar[after] ** 0.5)
        rows["eps_share"].append((1 - bar[after]) ** 0.5)
    return _columns(rows)


def mish(entry, x, out):
    """Computes Mish: x tanh(softplus x) = x n / (n + 2), n = e^x (e^x + 2); above 20 it is x."""
    power = entry.op("Exp", [entry.op("Min", [x, entry.scalar("twenty", 20.0)], out + ".low")], out + ".exp")
    two = entry.scalar("two", 2.0)
    n = entry.op("Mul", [power, entry.op("Add", [power, two], out + ".plus")], out + ".n")
    share = entry.op("Div", [n, entry.op("Add", [n, two], out + ".over")], out + ".share")
    return entry.op("Mul", [x, share], out)


class Pass:
    """Coefficients of the pass that an entry runs, and sums of products with them."""

    def __init__(self, entry, name, tables, number):
        self.entry = entry
        self.rows = {key: entry.op("Gather", [entry.weight(f"{name}.{key}", table), number], key, axis=0) for key, table in tables.items()}

    def sum(self, terms, out):
        """Sums products: [(value, coefficient), ...] -> their sum."""
        products = [self.entry.op("Mul", [value, self.rows[key]], f"{out}.{place}") for place, (value, key) in enumerate(terms)]
        total = products[0]
        for place, product in enumerate(products[1:], 1):
            total = self.entry.op("Add", [total, product], out if place == len(products) - 1 else f"{out}.sum{place}")
        return total


def dense(entry, x, module, name, out, weight=None):
    """Computes a linear layer of rows [m, k]."""
    weight = entry.weight(f"{name}.weight", module.weight if weight is None else weight)
    return entry.gemm(x, weight, entry.weight(f"{name}.bias", module.bias), out)
