"""Makes LADS policies with random weights, through the same code as trained ones: for tests of the compiler and the runtime."""

import numpy as np
import torch

from . import bundle, contract as contracts, systems
from .config import UserError


def draw_weights(module, generator):
    """Draws weights of healthy size everywhere, so that every token and every term matters in the outputs."""
    draw = lambda tensor: torch.randn(tensor.shape, generator=generator)
    with torch.no_grad():
        for name, value in module.named_parameters():
            if "norm" in name and name.endswith("weight"):
                value.copy_(1 + 0.2 * draw(value))
            elif value.dim() > 1:
                value.copy_(draw(value) / value.shape[-1] ** 0.5)
            elif name.endswith("bias"):
                value.copy_(0.2 * draw(value))


def place_normalizer(normalizer, rows):
    """Sets statistics of observations that fill a good part of their limits."""
    centre, half = _limits(*([row[key] for row in rows] for key in ("min", "max")))
    normalizer.mean.copy_(torch.from_numpy(centre + 0.1 * half))
    normalizer.std.copy_(torch.from_numpy(0.3 * half))


def place(networks, rows, seed):
    """Sets what is of healthy size by what is observed: the normaliser's statistics, or convolutions that keep the size of a frame's values; features
    are not normalised."""
    if not hasattr(networks, "frames"):
        place_normalizer(networks.normalizer, rows)
        return
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in networks.frames.modules():
            if isinstance(module, torch.nn.Conv2d):
                module.weight.copy_(torch.randn(module.weight.shape, generator=generator) * (2 / module.weight[0].numel()) ** 0.5)


def _limits(low, high):
    low, high = np.array(low, np.float64), np.array(high, np.float64)
    return (low + high) / 2, (high - low) / 2


def randomize(lads, setting, seed, placed=True):
    """Sets random weights of a LADS policy."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda tensor: torch.randn(tensor.shape, generator=generator)
    draw_weights(lads, generator)
    with torch.no_grad():
        lads.high_level.embed_timestep.weight.copy_(0.3 * draw(lads.high_level.embed_timestep.weight))
        lads.high_level.head.weight.mul_(2)
        for norm in getattr(lads.low_level, "norms", ()):  # only the MLP has batch norms
            norm.running_mean.copy_(0.2 * draw(norm.running_mean))
            norm.running_var.copy_(0.5 + torch.rand(norm.running_var.shape, generator=generator))
        if placed:
            place(lads, setting.environment["observation"], seed)
        lads.codebook.codes.copy_(draw(lads.codebook.codes))
        lads.codebook.started.fill_(True)


def wave(low, high, steps, seed):
    """Makes smooth values [steps, n] well inside the limits."""
    centre, half = _limits(low, high)
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 2 * np.pi, len(centre)), rng.uniform(0.01, 0.2, len(centre))
    wave = np.sin(phase + speed * np.arange(steps)[:, None]) * rng.uniform(0.1, 0.6, len(centre))
    return (centre + half * (wave + 0.01 * rng.uniform(-1, 1, wave.shape))).astype(np.float32)


def observations(setting, steps, seed):
    """Makes smooth observations [steps, O] well inside the limits."""
    rows = setting.environment["observation"]
    return wave(*([row[key] for row in rows] for key in ("min", "max")), steps, seed)


def channels(contract, steps, seed):
    """Makes observations for every channel of a contract: {name: [steps, ...]}."""
    found = {}
    for number, row in enumerate(contracts.of_role(contract, "observation")):
        low, high = contracts.limits(row)
        if row["dtype"] == "f32":
            flat = wave(low, high, steps, [seed, number]) if "elements" in row else wave(low * _size(row), high * _size(row), steps, [seed, number])
        else:
            draw = np.random.default_rng([seed, number])
            flat = draw.integers(low[0], high[0], (steps, _size(row)), contracts.DTYPES[row["dtype"]], endpoint=True)
        found[row["name"]] = flat.reshape(steps, *row["shape"])
    return found


def _size(row):
    return int(np.prod(row["shape"]))


def export(setting, encoded, seed, steps=None):
    """Makes a bundle with random weights and a golden episode of so many control steps, or over the whole context."""
    seen = setting.config.images.channel
    if bool(seen) != (setting.rendering is not None):
        raise UserError(f"{setting.config.name}: {'sees frames; say how they are drawn with --rendering' if seen else 'sees no frames; leave --rendering out'}")
    torch.manual_seed(seed)
    lads = systems.of(setting.config).Networks(setting, encoded)
    randomize(lads, setting, seed)
    steps = steps or setting.config.high_level.context_steps
    count = len(setting.instructions)
    if seen:
        drawn = lambda tried: np.random.default_rng([seed, tried]).integers(0, 256, (steps, *setting.rendering["size"], 3), np.uint8)
    else:
        drawn = lambda tried: observations(setting, steps, seed + tried)
    candidates = ((tried % count, drawn(tried)) for tried in range(1, 200))
    provenance = {"dataset_sha256": "", "seed": seed, "steps": {}}
    return lads, bundle.assemble(lads, setting, encoded, provenance, candidates)
