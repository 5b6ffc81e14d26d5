"""Kind `plain`: observation to action, without instructions, plans or a context; `recurrent` and `stacked` are plain with states, `camera`
with channels of other types."""

import numpy as np
import torch
from onnx import TensorProto
from torch import nn

from .. import bundle, contract as contracts, graphs
from ..model import Normalizer
from . import common

ENTRY = "policy/act"
COMMAND = [{"name": name, "unit": "m/s", "min": -1.0, "max": 1.5} for name in ("forward", "sideways")]


class Plain(nn.Module):
    """Policy of an MLP with tanh from the normalised observation to the action."""

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.first = nn.Linear(sizes.observation, sizes.hidden)
        self.middle = nn.Linear(sizes.hidden, sizes.hidden)
        self.last = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, observations):
        """Computes the actions: observations [T, O] in raw units -> actions [T, A]."""
        x = torch.tanh(self.first(self.normalizer(observations)))
        return self.last(torch.tanh(self.middle(x)))


class Recurrent(nn.Module):
    """Policy of a linear layer, a GRU, an LSTM, a linear layer."""

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.first = nn.Linear(sizes.observation, sizes.hidden)
        self.gru = nn.GRU(sizes.hidden, 24)
        self.lstm = nn.LSTM(24, 16)
        self.last = nn.Linear(16, sizes.action)

    def forward(self, observations):
        """Computes the actions: observations [T, O] of an episode from its start -> actions [T, A]."""
        x = torch.tanh(self.first(self.normalizer(observations)))
        return self.last(self.lstm(self.gru(x)[0])[0])


class Stacked(nn.Module):
    """Policy of an MLP over the last observations and a command."""

    ROWS = 5

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.first = nn.Linear(self.ROWS * sizes.observation + len(COMMAND), sizes.hidden)
        self.last = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, observations, commands):
        """Computes the actions: observations [T, O] of an episode from its start, commands [T, C] -> actions [T, A]."""
        normed = self.normalizer(observations)
        padded = torch.cat([normed[:1].expand(self.ROWS - 1, -1), normed])
        stacks = torch.stack([padded[t : t + self.ROWS].flatten() for t in range(len(normed))])
        return self.last(torch.tanh(self.first(torch.cat([stacks, commands], 1))))


class Camera(nn.Module):
    """Policy of an MLP over the observation, a small image and whole numbers."""

    IMAGE, MODES = [6, 8, 3], 2

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.pixels = nn.Linear(6 * 8 * 3, 12)
        self.first = nn.Linear(sizes.observation + 12 + self.MODES, sizes.hidden)
        self.last = nn.Linear(sizes.hidden, sizes.action)

    def forward(self, observations, images, modes):
        """Computes the actions: observations [T, O], images [T, 6, 8, 3] of bytes, modes [T, 2] of whole numbers -> actions [T, A]."""
        seen = torch.tanh(self.pixels(images.flatten(1).float() / 255))
        return self.last(torch.tanh(self.first(torch.cat([self.normalizer(observations), seen, modes.float()], 1))))


def _dense(entry, x, module, out, weight=None):
    weight = entry.weight(f"policy.{out}.weight", module.weight if weight is None else weight)
    return entry.gemm(x, weight, entry.weight(f"policy.{out}.bias", module.bias), out)


def _start(policy):
    """Starts the entry of a policy that observes one vector, up to its first hidden layer."""
    graph = graphs.Graph()
    entry = graphs.Entry(graph, ENTRY)
    observation = entry.input("observation", [1, len(policy.normalizer.mean)])
    centred = entry.centred(observation, policy.normalizer, "observation_centred")
    x = _dense(entry, centred, policy.first, "first", graphs.fold_std(policy.first.weight, policy.normalizer))
    return graph, entry, entry.op("Tanh", [x], "first.tanh")


def _finish(graph, entry, x, policy):
    _dense(entry, x, policy.last, "action")
    entry.output("action", [1, policy.last.out_features])
    return graph.model("plain")


def build_plain(policy, sizes):
    graph, entry, x = _start(policy)
    x = entry.op("Tanh", [_dense(entry, x, policy.middle, "middle")], "middle.tanh")
    return _finish(graph, entry, x, policy)


def _cell(entry, kind, x, module, order, states, **attributes):
    """Adds one step of a recurrent layer as an ONNX node: x [1, k] and states [1, h] -> the output [1, h]; the states are outputs too."""
    name, hidden = kind.lower(), module.hidden_size
    gates = len(module.bias_ih_l0) // hidden
    turn = lambda array: np.concatenate([np.split(graphs.double(array), gates)[gate] for gate in order])
    sequence = entry.op("Unsqueeze", [x, entry.integers("axis_zero", [0])], f"{name}.sequence")
    weights = [entry.weight(f"policy.{name}.{part}", turn(getattr(module, f"weight_{key}_l0"))[None]) for part, key in (("input", "ih"), ("recurrent", "hh"))]
    bias = entry.weight(f"policy.{name}.bias", np.concatenate([turn(module.bias_ih_l0), turn(module.bias_hh_l0)])[None])
    before = []
    for state in states:
        given = entry.input(state, [1, hidden])
        before.append(entry.op("Unsqueeze", [given, entry.integers("axis_zero", [0])], f"{state}.sequence"))
    outs = [f"{name}.all", *(f"{state}.last" for state in states)]
    _, *after = entry.op(kind, [sequence, *weights, bias, "", *before], outs, hidden_size=hidden, **attributes)
    for state, value in zip(states, after):
        entry.op("Squeeze", [value, entry.integers("axis_zero", [0])], f"next_{state}")
        entry.output(f"next_{state}", [1, hidden])
    return f"{ENTRY}/next_{states[0]}"


def gru(entry, x, module):
    """Adds one step of a GRU, its state `gru_h` among the inputs and outputs: x [1, k] -> [1, h]."""
    # ONNX orders the gates z, r, h; PyTorch r, z, n.
    return _cell(entry, "GRU", x, module, (1, 0, 2), ["gru_h"], linear_before_reset=1)


def build_recurrent(policy, sizes):
    graph, entry, x = _start(policy)
    x = gru(entry, x, policy.gru)
    # ONNX orders the gates i, o, f, c; PyTorch i, f, g, o.
    x = _cell(entry, "LSTM", x, policy.lstm, (0, 3, 1, 2), ["lstm_h", "lstm_c"])
    return _finish(graph, entry, x, policy)


def build_stacked(policy, sizes):
    graph = graphs.Graph()
    entry = graphs.Entry(graph, ENTRY)
    rows, width = policy.ROWS, sizes.observation
    stack, command = entry.input("stack", [rows, width]), entry.input("command", [1, len(COMMAND)])
    centred = entry.centred(stack, policy.normalizer, "stack_centred")
    flat = entry.op("Reshape", [centred, entry.integers("policy.flat", [1, rows * width])], "stack_flat")
    x = entry.op("Concat", [flat, command], "stack_and_command", axis=1)
    weight = graphs.double(policy.first.weight)
    weight[:, : rows * width] /= np.tile(graphs.double(policy.normalizer.std), rows)
    x = entry.op("Tanh", [_dense(entry, x, policy.first, "first", weight)], "first.tanh")
    return _finish(graph, entry, x, policy)


def build_camera(policy, sizes):
    graph = graphs.Graph()
    entry = graphs.Entry(graph, ENTRY)
    observation = entry.input("observation", [1, sizes.observation])
    image = entry.input("camera", [1, *policy.IMAGE], TensorProto.UINT8)
    modes = entry.input("mode", [1, policy.MODES], TensorProto.INT32)
    bytes_ = entry.op("Cast", [image], "camera_cast", to=TensorProto.FLOAT)
    shares = entry.op("Div", [bytes_, entry.scalar("largest_byte", 255.0)], "camera_scaled")
    flat = entry.op("Reshape", [shares, entry.integers("policy.pixels", [1, policy.pixels.in_features])], "camera_flat")
    seen = entry.op("Tanh", [_dense(entry, flat, policy.pixels, "pixels")], "pixels.tanh")
    centred = entry.centred(observation, policy.normalizer, "observation_centred")
    numbers = entry.op("Cast", [modes], "mode_cast", to=TensorProto.FLOAT)
    x = entry.op("Concat", [centred, seen, numbers], "joined", axis=1)
    weight = graphs.fold_std(policy.first.weight, policy.normalizer)
    x = entry.op("Tanh", [_dense(entry, x, policy.first, "first", weight)], "first.tanh")
    return _finish(graph, entry, x, policy)


def contract(sizes, seed, kind="plain", states=None, more=()):
    channels = contracts.channels(common.ENVIRONMENT)
    channels[1:1] = more
    provenance = {"setting": f"random {kind}", "seed": seed}
    return bundle.describe({"kind": "plain"}, common.ENVIRONMENT, [], None, provenance, channels=channels, states=states)


def state(name, width):
    """Describes a state of so many numbers, cleared by an episode's start."""
    return {"name": name, "shape": [1, width], "kind": "plain", "cleared_by": "episode"}


def contract_recurrent(sizes, seed):
    states = [state("gru_h", 24), state("lstm_h", 16), state("lstm_c", 16)]
    return contract(sizes, seed, "recurrent", states)


def contract_stacked(sizes, seed):
    stack = {"name": "stack", "kind": "ring", "rows": Stacked.ROWS, "source": "observation", "fill": "first", "cleared_by": "episode"}
    return contract(sizes, seed, "stacked", [stack], [contracts.vector("command", "observation", COMMAND)])


def contract_camera(sizes, seed):
    image = contracts.camera("camera", Camera.IMAGE[:2])
    modes = contracts.array("mode", "observation", [Camera.MODES], "i32", min=-1, max=2)
    return contract(sizes, seed, "camera", more=[image, modes])
