"""The temporal U-Net of SkillDiffuser, and its nodes: it predicts the noise in L rows of embedded observations, given the noise level and
the option.

Convolutions over rows stand in a graph as products of shifted rows side by side; taps that meet only the zeros beyond both ends are left out. Level and
option reach each block through a linear layer on Mish of both, whose halves are two tables: a row per pass and a row per option.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from .denoising import mish, sinusoids


@dataclass(frozen=True)
class Shape:
    """Sizes of the U-Net, by default the bench's."""

    inputs: int = 16  # elements of a row, of the option and of the embedded level
    width: int = 8
    multiples: tuple = (1, 2, 4)
    groups: int = 4
    rows: int = 8
    levels: int = 20


class Block(nn.Module):
    """U-Net block: two convolutions with group norm and Mish, level and option added in between, and the input added at the end."""

    def __init__(self, inputs, outputs, shape):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv1d(n, outputs, 5, padding=2) for n in (inputs, outputs))
        self.norm1, self.norm2 = (nn.GroupNorm(shape.groups, outputs) for _ in range(2))
        self.embed = nn.Linear(2 * shape.inputs, outputs)
        self.skip = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else None

    def forward(self, x, told):
        """Runs the block: x [N, c, L], told [N, 2 E] -> [N, c', L]."""
        y = F.mish(self.norm1(self.conv1(x))) + self.embed(told)[:, :, None]
        y = F.mish(self.norm2(self.conv2(y)))
        return y + (x if self.skip is None else self.skip(x))


class Unet(nn.Module):
    """U-Net with two blocks at each length going down, two in the middle, two at each length going up."""

    def __init__(self, shape):
        super().__init__()
        self.shape = shape
        inputs, widths = shape.inputs, [shape.width * factor for factor in shape.multiples]
        self.register_buffer("sinusoids", torch.from_numpy(sinusoids(range(1, shape.levels + 1), inputs)), persistent=False)
        self.embed_level, self.embed_option = (nn.Sequential(nn.Linear(inputs, 4 * inputs), nn.Mish(), nn.Linear(4 * inputs, inputs)) for _ in range(2))
        pair = lambda a, b: nn.ModuleList([Block(a, b, shape), Block(b, b, shape)])
        self.down = nn.ModuleList(pair(a, b) for a, b in zip([inputs, *widths], widths))
        self.halve = nn.ModuleList(nn.Conv1d(n, n, 3, 2, 1) for n in widths[:-1])
        self.middle = pair(widths[-1], widths[-1])
        self.up = nn.ModuleList(pair(2 * a, b) for a, b in zip(widths[:0:-1], widths[-2::-1]))
        self.widen = nn.ModuleList(nn.ConvTranspose1d(n, n, 4, 2, 1) for n in widths[-2::-1])
        self.conv, self.norm = nn.Conv1d(widths[0], widths[0], 5, padding=2), nn.GroupNorm(shape.groups, widths[0])
        self.last = nn.Conv1d(widths[0], inputs, 1)

    def told(self, levels, options, known):
        """Embeds level and option: levels [N] from 1, options [N, E], known [N, 1] (0 leaves the option out) -> [N, 2 E]."""
        return F.mish(torch.cat([self.embed_level(self.sinusoids[levels - 1]), self.embed_option(options) * known], 1))

    def forward(self, x, told):
        """Predicts the noise in x [N, L, inputs]."""
        x, fine = x.transpose(1, 2), []
        for place, blocks in enumerate(self.down):
            for block in blocks:
                x = block(x, told)
            fine.append(x)
            if place < len(self.halve):
                x = self.halve[place](x)
        for block in self.middle:
            x = block(x, told)
        for blocks, widen in zip(self.up, self.widen):
            x = torch.cat([x, fine.pop()], 1)
            for block in blocks:
                x = block(x, told)
            x = widen(x)
        return self.last(F.mish(self.norm(self.conv(x)))).transpose(1, 2)


class Nodes:
    """Nodes of a U-Net for one row of level and option tables; names of values start with `prefix`."""

    def __init__(self, entry, net, tables, prefix):
        self.entry, self.net, self.tables, self.prefix = entry, net, tables, prefix

    def run(self, x):
        """Adds the nodes that predict the noise in x [L, inputs]."""
        net, rows, fine = self.net, self.net.shape.rows, []
        for place, blocks in enumerate(net.down):
            x = self.blocks(x, blocks, f"down.{place}", rows)
            fine.append(x)
            if place < len(net.halve):
                x, rows = self.halve(x, net.halve[place], f"halve.{place}", rows), rows // 2
        x = self.blocks(x, net.middle, "middle", rows)
        for place, (blocks, widen) in enumerate(zip(net.up, net.widen)):
            x = self.entry.op("Concat", [x, fine.pop()], f"{self.prefix}.up.{place}.joined", axis=1)
            x = self.blocks(x, blocks, f"up.{place}", rows)
            x, rows = self.widen(x, widen, f"widen.{place}", rows), 2 * rows
        x = self.conv(x, net.conv, "conv", rows)
        x = mish(self.entry, self.group_norm(x, net.norm, rows, "norm"), f"{self.prefix}.norm.mish")
        return self.conv(x, net.last, "last", rows)

    def blocks(self, x, blocks, name, rows):
        for place, block in enumerate(blocks):
            x = self.block(x, block, f"{name}.{place}", rows)
        return x

    def block(self, x, block, name, rows):
        entry, out = self.entry, f"{self.prefix}.{name}"
        y = self.conv(x, block.conv1, name + ".conv1", rows)
        y = mish(entry, self.group_norm(y, block.norm1, rows, name + ".norm1"), out + ".norm1.mish")
        y = entry.op("Add", [y, self.tables.row(self.prefix, name)], out + ".told")
        y = self.conv(y, block.conv2, name + ".conv2", rows)
        y = mish(entry, self.group_norm(y, block.norm2, rows, name + ".norm2"), out + ".norm2.mish")
        return entry.op("Add", [y, x if block.skip is None else self.conv(x, block.skip, name + ".skip", rows)], out + ".out")

    def shifted(self, x, offset, width, rows, name):
        """Shifts rows: row i of the result is row i + offset of x [rows, width], zeros beyond the ends."""
        if offset == 0:
            return x
        entry, out = self.entry, f"{self.prefix}.{name}.shift.{offset}"
        number = lambda n: entry.integers(f"number.{n}", [n])
        nothing = entry.graph.constant(f"constants/zeros.{abs(offset)}.{width}", np.zeros((abs(offset), width), np.float32))
        ends = (0, rows + offset) if offset < 0 else (offset, rows)
        kept = entry.op("Slice", [x, number(ends[0]), number(ends[1]), number(0)], out + ".kept")
        return entry.op("Concat", [nothing, kept] if offset < 0 else [kept, nothing], out, axis=0)

    def taps(self, x, offsets, width, rows, name):
        """Places x at several offsets side by side: [rows, len(offsets) * width]."""
        parts = [self.shifted(x, offset, width, rows, name) for offset in offsets]
        return parts[0] if len(parts) == 1 else self.entry.op("Concat", parts, f"{self.prefix}.{name}.taps", axis=1)

    def conv(self, x, module, name, rows):
        reach = min(module.kernel_size[0] // 2, rows - 1)
        offsets = range(-reach, reach + 1)
        seen = self.taps(x, offsets, module.in_channels, rows, name)
        return self._gemm(seen, module, [offset + module.kernel_size[0] // 2 for offset in offsets], name)

    def _gemm(self, seen, module, taps, name):
        entry = self.entry
        weight = module.weight.detach()[:, :, taps].transpose(1, 2).flatten(1)
        return entry.gemm(seen, entry.weight(f"denoiser.{name}.weight", weight), entry.weight(f"denoiser.{name}.bias", module.bias), f"{self.prefix}.{name}")

    def halve(self, x, module, name, rows):
        """Computes a convolution of three taps at every second row."""
        seen = self.taps(x, (-1, 0, 1), module.in_channels, rows, name)
        even = self.entry.integers(f"even_rows.{rows}", list(range(0, rows, 2)))
        return self._gemm(self.entry.op("Gather", [seen, even], f"{self.prefix}.{name}.even", axis=0), module, [0, 1, 2], name)

    def widen(self, x, module, name, rows):
        """Computes a transposed convolution of four taps: even rows from the row and the one before it, odd ones from the row and the one
        after it."""
        entry, out, width = self.entry, f"{self.prefix}.{name}", module.in_channels
        halves = []
        for half, offsets, taps in (("even", (-1, 0), (3, 1)), ("odd", (0, 1), (2, 0))):
            seen = self.taps(x, offsets, width, rows, f"{name}.{half}")
            weight = module.weight.detach()[:, :, taps].permute(1, 2, 0).flatten(1)
            bias = entry.weight(f"denoiser.{name}.bias", module.bias)
            halves.append(entry.gemm(seen, entry.weight(f"denoiser.{name}.{half}.weight", weight), bias, f"{out}.{half}"))
        joined = entry.op("Concat", halves, out + ".joined", axis=1)
        return entry.op("Reshape", [joined, entry.integers(f"shape.{2 * rows}.{width}", [2 * rows, width])], out)

    def group_norm(self, x, module, rows, name):
        """Normalises each group of columns over all rows: a layer norm of [groups, rows * columns]."""
        entry, out, groups, width = self.entry, f"{self.prefix}.{name}", module.num_groups, module.num_channels
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
        scaled = entry.op("Mul", [rows_again, entry.weight(f"denoiser.{name}.scale", module.weight)], out + ".scaled")
        return entry.op("Add", [scaled, entry.weight(f"denoiser.{name}.bias", module.bias)], out)


class Tables:
    """Tables of what the blocks add: for each a table over the passes and one over the options, the last of which stands for no option."""

    def __init__(self, entry, net, levels, options, number):
        """Makes the tables from the levels of each pass and options [M, E]; number: the name of the pass."""
        self.entry, self.number, self.chosen, self.times = entry, number, {}, {}
        with torch.no_grad():
            time = F.mish(net.embed_level(net.sinusoids[torch.tensor(levels) - 1])).double()
            option = F.mish(net.embed_option(options)).double()
            option = torch.cat([option, torch.zeros_like(option[:1])])
            self.weights = {}
            for name, block in net.named_modules():
                if isinstance(block, Block):
                    on_time, on_option = block.embed.weight.double().chunk(2, 1)
                    self.weights[name] = time @ on_time.T + block.embed.bias.double(), option @ on_option.T

    def choose(self, prefix, index):
        """Chooses the option whose rows the nodes with this prefix add."""
        self.chosen[prefix] = index

    def row(self, prefix, name):
        """Returns the row that the block `name` adds, [1, c]."""
        entry, (time, option) = self.entry, self.weights[name]
        if name not in self.times:
            self.times[name] = entry.op("Gather", [entry.weight(f"denoiser.{name}.levels", time), self.number], f"{name}.level", axis=0)
        told = entry.op("Gather", [entry.weight(f"denoiser.{name}.options", option), self.chosen[prefix]], f"{prefix}.{name}.option", axis=0)
        return entry.op("Add", [self.times[name], told], f"{prefix}.{name}.both")
