"""Makes policy files in the forms that public repositories have: one small ONNX file each, with random weights of its own.

    python tests/parity/forms.py FOLDER

writes them all as `NAME.onnx`. Most are exported by PyTorch, with the exporter by tracing at operator sets 11, 13, 17 and 18 and with the
newer one (`-dynamo`, where `onnxscript` is installed); the others are built node by node, as tf2onnx and hand-written converters leave
them. Names of inputs and outputs, shapes and quirks are those of the field, sizes are not. The same seed gives the same files.
"""

import importlib.util
import io
import json
import pathlib
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from torch.onnx.errors import UnsupportedOperatorError

OPSETS = (11, 13, 17, 18)
N, M = 12, 4  # observations and actions of most forms


@dataclass
class Form:
    """A policy file, and what its owner knows of it."""

    name: str
    model: onnx.ModelProto
    action: str
    states: dict = field(default_factory=dict)  # input: the output that it becomes
    limits: dict = field(default_factory=dict)  # input: the range of what it is given, where that is not -3 to 3


def mlp(activation, n=N, m=M, hidden=(32, 24, 16)):
    widths = [n, *hidden]
    layers = [part for k, h in zip(widths, hidden, strict=False) for part in (nn.Linear(k, h), activation())]
    return nn.Sequential(*layers, nn.Linear(widths[-1], m))


class Normalized(nn.Module):
    """Form of rsl_rl and mjlab: the normaliser is in the graph."""

    def __init__(self, by_division):
        super().__init__()
        self.register_buffer("mean", torch.randn(1, N) * 0.3)
        self.register_buffer("std", torch.rand(1, N) + 0.5)
        self.actor, self.by_division = mlp(nn.ELU), by_division

    def forward(self, x):
        centred = x - self.mean
        scaled = centred / (self.std + 1e-2) if self.by_division else centred * (1 / self.std)
        return self.actor(torch.clamp(scaled, -5.0, 5.0))


class GaussianHead(nn.Module):
    """Form with actions, and log-probabilities that a controller does not need."""

    def __init__(self):
        super().__init__()
        self.body, self.mean, self.log_std = mlp(nn.Tanh, m=16), nn.Linear(16, M), nn.Parameter(torch.zeros(M))

    def forward(self, x):
        mean = self.mean(self.body(x))
        std = torch.exp(self.log_std.expand_as(mean))
        return torch.tanh(mean), (-(((mean - 0.1) / std) ** 2) / 2 - torch.log(std)).sum(-1, keepdim=True)


class Recurrent(nn.Module):
    """Form of rsl_rl and Isaac Lab: a recurrent layer with its state at the edge of the graph."""

    def __init__(self, kind, layers=1, hidden=16):
        super().__init__()
        self.rnn = kind(N, hidden, layers)
        self.actor = mlp(nn.ELU, n=hidden, hidden=(24, 16))

    def forward(self, obs, h_in, c_in=None):
        if c_in is None:
            x, h = self.rnn(obs.unsqueeze(0), h_in)
            return self.actor(x.squeeze(0)), h
        x, (h, c) = self.rnn(obs.unsqueeze(0), (h_in, c_in))
        return self.actor(x.squeeze(0)), h, c


class GruCell(nn.Module):
    """Form of torchrl: a GRU cell, with a flag that clears the state."""

    def __init__(self, hidden=16):
        super().__init__()
        self.cell, self.actor = nn.GRUCell(N, hidden), mlp(nn.Mish, n=hidden, hidden=(24,))

    def forward(self, obs, adapt_hx, is_init):
        hx = torch.where(is_init, torch.zeros_like(adapt_hx), adapt_hx)
        i, h = self.cell.weight_ih @ obs[0] + self.cell.bias_ih, self.cell.weight_hh @ hx[0] + self.cell.bias_hh
        (i_r, i_z, i_n), (h_r, h_z, h_n) = i.chunk(3), h.chunk(3)
        r, z = torch.sigmoid(i_r + h_r), torch.sigmoid(i_z + h_z)
        n = torch.tanh(i_n + r * h_n)
        hx = ((1 - z) * n + z * hx[0]).unsqueeze(0)
        return self.actor(hx), hx


class Window(nn.Module):
    """Form with a GRU over a window of observations, without a state."""

    def __init__(self, steps, width=6, hidden=16):
        super().__init__()
        self.steps, self.width = steps, width
        self.rnn, self.actor = nn.GRU(width, hidden, batch_first=True), mlp(nn.ELU, n=hidden, hidden=(24,))

    def forward(self, obs):
        x, _ = self.rnn(obs.view(1, self.steps, self.width))
        return self.actor(x[:, -1])


class Convolved(nn.Module):
    """Form with 1-d convolutions over a history."""

    def __init__(self, steps=20, width=6):
        super().__init__()
        self.steps, self.width = steps, width
        self.encoder = nn.Sequential(nn.Conv1d(width, 8, 6, stride=3), nn.ELU(), nn.Conv1d(8, 8, 3), nn.ELU(), nn.Flatten())
        self.actor = mlp(nn.ELU, n=24, hidden=(24,))

    def forward(self, obs):
        return self.actor(self.encoder(obs.view(1, self.steps, self.width).transpose(1, 2)))


class Latent(nn.Module):
    """Form with an encoder whose latent vector has length one, joined with the newest observation."""

    def __init__(self):
        super().__init__()
        self.encoder, self.actor = mlp(nn.ELU, m=6, hidden=(24,)), mlp(nn.ELU, n=6 + 4)

    def forward(self, x):
        latent = nn.functional.normalize(self.encoder(x), dim=-1, p=2)
        return self.actor(torch.cat([latent, x[:, -4:]], -1))


class Normed(nn.Module):
    """Form with layer norm between the layers."""

    def __init__(self):
        super().__init__()
        self.actor = nn.Sequential(nn.Linear(N, 24), nn.LayerNorm(24), nn.Mish(), nn.Linear(24, 16), nn.LayerNorm(16), nn.Softplus(), nn.Linear(16, M))

    def forward(self, x):
        return self.actor(x)


class Motion(nn.Module):
    """Form of whole_body_tracking: a policy with the motion that it follows, by time step."""

    def __init__(self, steps=40):
        super().__init__()
        self.actor, self.total = mlp(nn.ELU), steps
        for name, width in (("joint_pos", 4), ("joint_vel", 4), ("ref_pos_xyz", 3), ("ref_quat_xyzw", 4)):
            self.register_buffer(name, torch.randn(steps, width))

    def forward(self, obs, time_step):
        at = torch.clamp(time_step.long().squeeze(-1), max=self.total - 1)
        reference = torch.cat([self.joint_pos[at], self.joint_vel[at]], -1)
        actions = self.actor(torch.cat([obs[:, :4], reference], -1))
        return actions, self.joint_pos[at], self.joint_vel[at], self.ref_pos_xyz[at], self.ref_quat_xyzw[at]


class Attentive(nn.Module):
    """Form with products of three axes, written as Einstein sums, and a softmax."""

    def __init__(self):
        super().__init__()
        self.embed, self.out = nn.Linear(4, 8), nn.Linear(24, M)

    def forward(self, x):
        tokens = self.embed(x.view(1, 3, 4))
        weights = torch.softmax(torch.einsum("bik,bjk->bij", tokens, tokens), dim=-1)
        return self.out(torch.einsum("bij,bjk->bik", weights, tokens).flatten(1))


class Folded(nn.Module):
    """Form with leftovers of indexing and assignments: operators over constants alone."""

    def __init__(self):
        super().__init__()
        self.actor = mlp(nn.ELU)

    def forward(self, x):
        mask = torch.zeros(N)
        mask[2:7] = 1.0
        scale = torch.where(torch.arange(N) == 3, torch.full((N,), 2.0), torch.ones(N))
        noise = torch.zeros_like(x)
        noise[:, 1] = 0.5
        return self.actor(x * mask * scale.expand(x.shape[0], -1) + noise)


def traced(module, inputs, names, outputs, opset, dynamo=False, batch=None):
    """Exports a module by tracing; values of `batch` get a symbolic first axis of that name."""
    axes = {name: {0: batch} for name in [*names, *outputs]} if batch else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if dynamo:
            program = torch.onnx.export(module.eval(), inputs, input_names=names, output_names=outputs, opset_version=opset, dynamo=True, verbose=False)
            return program.model_proto
        file = io.BytesIO()
        torch.onnx.export(module.eval(), inputs, file, input_names=names, output_names=outputs, opset_version=opset, dynamo=False, dynamic_axes=axes)
    return onnx.load_from_string(file.getvalue())


def torch_forms():
    """Lists the forms that PyTorch exports: (name, module, inputs, names of inputs, names of outputs, states, limits, keywords), the action
    first."""
    observed = (torch.randn(1, N),)
    plain = (["obs"], ["actions"], {}, {})
    activations = [nn.ELU, nn.SELU, nn.Mish, nn.Softplus, nn.Hardswish, nn.Hardsigmoid, nn.Softsign, nn.PReLU, nn.ReLU6, nn.Hardtanh, nn.SiLU, nn.Sigmoid]
    for kind in [*activations, nn.LeakyReLU, nn.Tanh, nn.ReLU]:
        yield f"mlp-{kind.__name__.lower()}", mlp(kind), observed, *plain, {}
    yield "mlp-celu", mlp(lambda: nn.CELU(0.7)), observed, *plain, {}
    yield "mlp-gelu", mlp(nn.GELU), observed, *plain, {}
    yield "mlp-gelu-tanh", mlp(lambda: nn.GELU("tanh")), observed, *plain, {}
    yield "mlp-dropout-batchnorm", nn.Sequential(nn.Linear(N, 16), nn.BatchNorm1d(16), nn.ELU(), nn.Dropout(), nn.Linear(16, M)), observed, *plain, {}
    yield "rank-one", mlp(nn.ELU), (torch.randn(N),), ["nn_input"], ["action"], {}, {}, {}
    yield "batch", mlp(nn.ELU), observed, *plain, {"batch": "batch_size"}
    yield "normalizer-div", Normalized(True), observed, *plain, {}
    yield "normalizer-mul", Normalized(False), observed, *plain, {}
    yield "log-probabilities", GaussianHead(), observed, ["obs"], ["mu", "log_prob"], {}, {}, {}
    hidden = torch.zeros(1, 1, 16)
    yield "gru", Recurrent(nn.GRU), (*observed, hidden), ["obs", "h_in"], ["actions", "h_out"], {"h_in": "h_out"}, {}, {}
    two = torch.zeros(2, 1, 16)
    yield "gru-two-layers", Recurrent(nn.GRU, 2), (*observed, two), ["obs", "h_in"], ["actions", "h_out"], {"h_in": "h_out"}, {}, {}
    for name, layers, start in (("lstm", 1, hidden), ("lstm-two-layers", 2, two)):
        states = {"h_in": "h_out", "c_in": "c_out"}
        yield name, Recurrent(nn.LSTM, layers), (*observed, start, start), ["obs", *states], ["actions", *states.values()], states, {}, {}
    given = (*observed, torch.zeros(1, 16), torch.zeros(1, dtype=torch.bool))
    yield "gru-cell-is-init", GruCell(), given, ["obs", "adapt_hx", "is_init"], ["action", "next_adapt_hx"], {"adapt_hx": "next_adapt_hx"}, {"is_init": (0, 1)}, {}
    yield "gru-window", Window(50), (torch.randn(1, 300),), *plain, {}
    yield "conv1d", Convolved(), (torch.randn(1, 120),), *plain, {}
    yield "latent", Latent(), observed, *plain, {}
    yield "layer-norm", Normed(), observed, *plain, {}
    outputs = ["actions", "joint_pos", "joint_vel", "ref_pos_xyz", "ref_quat_xyzw"]
    yield "motion", Motion(), (*observed, torch.zeros(1, 1)), ["obs", "time_step"], outputs, {}, {"time_step": (0, 50)}, {}
    yield "einsum", Attentive(), observed, *plain, {}
    yield "folded", Folded(), observed, *plain, {}


def built(nodes, constants, inputs, outputs, opset, ir=8, kind=TensorProto.FLOAT, listed=False):
    """Builds a graph of nodes. `listed`: the initializers are among the inputs too, as files of IR version 3 have them."""
    tensors = [numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items()]
    value = lambda name, shape: helper.make_tensor_value_info(name, kind, shape)
    given = [value(*pair) for pair in inputs.items()]
    if listed:
        given += [helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims) for tensor in tensors]
    graph = helper.make_graph(nodes, "policy", given, [value(*pair) for pair in outputs.items()], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir, producer_name="forms")


def built_forms(random):
    node = helper.make_node
    draw = lambda *shape: (random.normal(size=shape) / np.sqrt(shape[0])).astype(np.float32)
    single = {"obs": [1, N]}, {"continuous_actions": [1, M]}
    # brax and mujoco_playground, by tf2onnx: swish, then the first half of a split is the action.
    constants = {"w0": draw(N, 32), "b0": draw(32), "w1": draw(32, 2 * M), "b1": draw(2 * M)}
    nodes = [
        node("MatMul", ["obs", "w0"], ["x0"]),
        node("Add", ["x0", "b0"], ["x1"]),
        node("Sigmoid", ["x1"], ["x2"]),
        node("Mul", ["x1", "x2"], ["x3"]),
        node("MatMul", ["x3", "w1"], ["x4"]),
        node("Add", ["x4", "b1"], ["x5"]),
    ]
    tail = [node("Tanh", ["x6"], ["continuous_actions"])]
    yield "swish-split-11", built([*nodes, node("Split", ["x5"], ["x6", "x7"], axis=1, split=[M, M]), *tail], constants, *single, 11, 6), "continuous_actions"
    parts = constants | {"parts": np.array([M, M])}
    yield "swish-split-17", built([*nodes, node("Split", ["x5", "parts"], ["x6", "x7"], axis=1), *tail], parts, *single, 17), "continuous_actions"
    halves = node("Split", ["x5"], ["x6", "x7"], axis=1, num_outputs=2)
    yield "swish-split-18", built([*nodes, halves, *tail], constants, *single, 18), "continuous_actions"
    sequence = [node("SplitToSequence", ["x5", "part"], ["s"], axis=1), node("SequenceAt", ["s", "zero"], ["x6"])]
    yield "sequence", built([*nodes, *sequence, *tail], constants | {"part": np.int64(M), "zero": np.int64(0)}, *single, 11, 6), "continuous_actions"
    # Old operator sets: slices, limits and a softmax by attributes, initializers among the inputs.
    old = {"w0": draw(N, 16), "b0": draw(16), "w1": draw(10, M), "b1": draw(M)}
    nodes = [
        node("Pad", ["obs"], ["p"], pads=[0, 1, 0, 1], value=0.5),
        node("Slice", ["p"], ["o"], axes=[1], starts=[1], ends=[-1]),
        node("Gemm", ["o", "w0", "b0"], ["x0"], alpha=0.9),
        node("Clip", ["x0"], ["x1"], min=-0.8, max=1.2),
        node("Reshape", ["x1", "eight"], ["x2"]),
        node("Softmax", ["x2"], ["x3"]),
        node("Reshape", ["x3", "row"], ["x4"]),
        node("Slice", ["x4"], ["x5"], axes=[1], starts=[2], ends=[12]),
        node("Dropout", ["x5"], ["x6"], ratio=0.1),
        node("Gemm", ["x6", "w1", "b1"], ["actions"]),
    ]
    more = {"eight": np.array([2, 2, 4]), "row": np.array([1, 16])}
    for opset, ir in ((7, 3), (9, 4)):
        yield f"old-{opset}", built(nodes, old | more, {"obs": [1, N]}, {"actions": [1, M]}, opset, ir, listed=True), "actions"
    # Weights of other widths.
    for name, dtype, kind in (("float16", np.float16, TensorProto.FLOAT16), ("float64", np.float64, TensorProto.DOUBLE)):
        weights = {"w0": draw(N, 16).astype(dtype), "b0": draw(16).astype(dtype), "w1": draw(16, M).astype(dtype)}
        body = [node("Gemm", ["x", "w0", "b0"], ["h"]), node("Tanh", ["h"], ["t"]), node("MatMul", ["t", "w1"], ["y"])]
        ends = [node("Cast", ["obs"], ["x"], to=kind)], [node("Cast", ["y"], ["actions"], to=TensorProto.FLOAT)]
        yield f"{name}-weights", built([*ends[0], *body, *ends[1]], weights, {"obs": [1, N]}, {"actions": [1, M]}, 13), "actions"
        whole = [node("Identity", ["obs"], ["x"]), *body, node("Identity", ["y"], ["actions"])]
        yield f"{name}-edges", built(whole, weights, {"obs": [1, N]}, {"actions": [1, M]}, 13, kind=kind), "actions"
    # The pattern of `expand` with -1, and what else is over constants alone.
    nodes = [
        node("Shape", ["obs"], ["shape"]),
        node("ConstantOfShape", ["two"], ["ones"], value=helper.make_tensor("v", TensorProto.INT64, [1], [1])),
        node("Mul", ["ones", "minus"], ["wild"]),
        node("Equal", ["given", "wild"], ["open"]),
        node("Where", ["open", "shape", "given"], ["target"]),
        node("Expand", ["gain", "target"], ["gains"]),
        node("Range", ["r0", "r1", "r2"], ["steps"]),
        node("Cast", ["steps"], ["ramp"], to=TensorProto.FLOAT),
        node("Tile", ["ramp", "twice"], ["ramps"]),
        node("Greater", ["ramps", "half"], ["high"]),
        node("Not", ["high"], ["low"]),
        node("And", ["high", "low"], ["never"]),
        node("Where", ["never", "gains", "ramps"], ["weights"]),
        node("ScatterND", ["weights", "at", "new"], ["scattered"]),
        node("EyeLike", ["square"], ["eye"], k=1),
        node("Mul", ["obs", "gains"], ["x0"]),
        node("Mul", ["x0", "scattered"], ["x1"]),
        node("MatMul", ["x1", "eye"], ["x2"]),
        node("Slice", ["x2", "from", "to", "axis", "step"], ["x3"]),
        node("Gather", ["x3", "order"], ["x4"], axis=1),
        node("MatMul", ["x4", "w"], ["actions"]),
    ]
    constants = {
        "two": np.array([2]), "minus": np.array([-1, -1]), "given": np.array([-1, N]), "gain": draw(N), "r0": np.int64(0), "r1": np.int64(N // 2),
        "r2": np.int64(1), "twice": np.array([2]), "half": np.float32(2.5), "at": np.array([[0, 1], [0, 4]]), "new": np.float32([0.25, -0.5]),
        "square": np.zeros((N, N), np.float32), "from": np.array([-1]), "to": np.array([-N - 1]), "axis": np.array([1]), "step": np.array([-2]),
        "order": np.array([5, 0, 3, 1]), "w": draw(4, M),
    }  # fmt: skip
    yield "constants", built(nodes, constants, {"obs": [1, N]}, {"actions": [1, M]}, 13), "actions"
    # Vectors on both sides of a product, and three axes at the edge.
    nodes = [node("MatMul", ["w0", "obs"], ["x0"]), node("Elu", ["x0"], ["x1"]), node("MatMul", ["x1", "w1"], ["x2"]), node("Add", ["x2", "b1"], ["actions"])]
    constants = {"w0": draw(16, N), "w1": draw(16, M), "b1": draw(M)}
    yield "rank-one-columns", built(nodes, constants, {"obs": [N]}, {"actions": [M]}, 11, 6), "actions"
    constants = {"w0": draw(N, 16), "b0": draw(16), "w1": draw(16, M)}
    nodes = [node("MatMul", ["obs", "w0"], ["x0"]), node("Add", ["x0", "b0"], ["x1"]), node("Elu", ["x1"], ["x2"], alpha=0.5), node("MatMul", ["x2", "w1"], ["actions"])]
    yield "rank-three", built(nodes, constants, {"obs": [1, 1, N]}, {"actions": [1, 1, M]}, 11, 6), "actions"
    # Operators newer than most exporters.
    nodes = [
        node("Gemm", ["obs", "w0", "b0"], ["x0"]), node("Mish", ["x0"], ["x1"]), node("HardSwish", ["x1"], ["x2"]), node("Gelu", ["x2"], ["x3"], approximate="tanh"),
        node("ThresholdedRelu", ["x3"], ["x4"], alpha=0.05), node("Celu", ["x0"], ["x5"], alpha=0.8), node("Add", ["x4", "x5"], ["x6"]),
        node("Reshape", ["x6", "channels"], ["x7"]), node("GroupNormalization", ["x7", "scale", "bias"], ["x8"], num_groups=2),
        node("InstanceNormalization", ["x8", "scale", "bias"], ["x9"]), node("Reshape", ["x9", "row"], ["x10"]), node("MatMul", ["x10", "w1"], ["actions"]),
    ]  # fmt: skip
    constants = {"w0": draw(N, 32), "b0": draw(32), "channels": np.array([1, 4, 8]), "scale": draw(4), "bias": draw(4), "row": np.array([1, 32]), "w1": draw(32, M)}
    yield "newer-21", built(nodes, constants, {"obs": [1, N]}, {"actions": [1, M]}, 21, 10), "actions"


def forms(wanted=lambda name: True):
    """Yields all forms whose names are wanted, in a fixed order."""
    newer = importlib.util.find_spec("onnxscript") is not None
    torch.manual_seed(7)
    for name, module, inputs, names, outputs, states, limits, more in torch_forms():
        for opset in OPSETS:
            # The exporter knows some operators from a later set on.
            with suppress(UnsupportedOperatorError):
                if wanted(f"{name}-{opset}"):
                    yield Form(f"{name}-{opset}", traced(module, inputs, names, outputs, opset, **more), outputs[0], states, limits)
        if newer and not more and wanted(f"{name}-dynamo"):
            yield Form(f"{name}-dynamo", traced(module, inputs, names, outputs, 18, dynamo=True), outputs[0], states, limits)
    for name, model, action in built_forms(np.random.default_rng(7)):
        if wanted(name):
            yield Form(name, model, action)


def main(folder):
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for form in forms():
        onnx.save(form.model, folder / f"{form.name}.onnx")
        known = {"action": form.action, "states": form.states, "limits": form.limits}
        (folder / f"{form.name}.json").write_text(json.dumps(known) + "\n")
        print(form.name)


if __name__ == "__main__":
    main(*sys.argv[1:])
