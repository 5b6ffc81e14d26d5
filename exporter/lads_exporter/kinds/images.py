"""Kind `images`: actions from what cameras see, through convolutions; and policies of the sizes that encoders have in the field, for
measurements.

An encoder is a list of steps, from which both the network in PyTorch and the entry graph are made. Frames are bytes [rows, columns, 3];
scale and mean are in the graph.
"""

from dataclasses import dataclass

import torch
from onnx import TensorProto
from torch import nn
from torch.nn import functional

from .. import contract as contracts, graphs, random_policy
from ..model import Normalizer
from . import common, plain


@dataclass(frozen=True)
class Conv:
    """Convolution, then batch normalisation (`norm` is its epsilon), a residual and an activation, each if set."""

    outputs: int
    kernel: int
    stride: int = 1
    pads: tuple = (0, 0, 0, 0)  # rows above, columns to the left, rows below, columns to the right
    depthwise: bool = False
    norm: float | None = None
    activation: str | None = "Relu"
    name: str | None = None
    source: str | None = None  # instead of the step before
    add: str | None = None


@dataclass(frozen=True)
class Pool:
    """A pooling layer."""

    operator: str  # MaxPool, AveragePool or GlobalAveragePool
    kernel: int = 0
    stride: int = 1
    pads: tuple = (0, 0, 0, 0)
    name: str | None = None


@dataclass(frozen=True)
class Camera:
    """A camera and its encoder; a pixel is (byte - mean) / scale, of all colours or of each."""

    name: str
    shape: tuple  # rows, columns
    steps: tuple
    mean: float | tuple = 0.0
    scale: float | tuple = 255.0


class Encoder(nn.Module):
    """Encoder of a camera's frames: its steps, then the flattened features."""

    def __init__(self, camera):
        super().__init__()
        self.camera, self.layers, channels, known = camera, nn.ModuleList(), 3, {}
        for step in camera.steps:
            layer = nn.Module()
            if isinstance(step, Conv):
                inputs = known[step.source] if step.source else channels
                groups = inputs if step.depthwise else 1
                layer.conv = nn.Conv2d(inputs, step.outputs, step.kernel, step.stride, groups=groups, bias=step.norm is None)
                if step.norm is not None:
                    layer.batch_norm = nn.BatchNorm2d(step.outputs, eps=step.norm)
                channels = step.outputs
            known[step.name] = channels
            self.layers.append(layer)

    def forward(self, frames):
        """Encodes frames [T, rows, columns, 3] of bytes -> [T, F]."""
        mean, scale = (torch.tensor(value, dtype=torch.float32) for value in (self.camera.mean, self.camera.scale))
        x, known = ((frames.float() - mean) / scale).permute(0, 3, 1, 2), {}
        for step, layer in zip(self.camera.steps, self.layers):
            top, left, bottom, right = step.pads
            if isinstance(step, Conv):
                x = layer.conv(functional.pad(known[step.source] if step.source else x, (left, right, top, bottom)))
                x = layer.batch_norm(x) if step.norm is not None else x
                x = x + known[step.add] if step.add else x
                x = {"Relu": functional.relu, "Relu6": functional.relu6, None: lambda x: x}[step.activation](x)
            elif step.operator == "MaxPool":
                x = functional.max_pool2d(functional.pad(x, (left, right, top, bottom), value=-torch.inf), step.kernel, step.stride)
            elif step.operator == "AveragePool":
                x = functional.avg_pool2d(x, step.kernel, step.stride)
            else:
                x = x.mean((2, 3), keepdim=True)
            known[step.name] = x
        return x.flatten(1)

    def features(self):
        with torch.no_grad():
            return self.eval()(torch.zeros(1, *self.camera.shape, 3)).shape[1]

    def build(self, entry):
        """Adds the encoder to an entry -> the flattened features [1, F]."""
        name = self.camera.name
        frame = entry.input(name, [1, *self.camera.shape, 3], TensorProto.UINT8)
        x = entry.op("Cast", [frame], f"{name}.floats", to=TensorProto.FLOAT)
        x = entry.op("Sub", [x, entry.scalar(f"{name}.mean", self.camera.mean)], f"{name}.centred")
        x = entry.op("Div", [x, entry.scalar(f"{name}.scale", self.camera.scale)], f"{name}.scaled")
        x, known = entry.op("Transpose", [x], f"{name}.channels_first", perm=[0, 3, 1, 2]), {}
        for number, (step, layer) in enumerate(zip(self.camera.steps, self.layers)):
            at = f"{name}.{number}"
            if isinstance(step, Conv):
                x = self._conv(entry, step, layer, known[step.source] if step.source else x, step.add and known[step.add], at)
            elif step.operator == "GlobalAveragePool":
                x = entry.op(step.operator, [x], at)
            else:
                x = entry.op(step.operator, [x], at, kernel_shape=[step.kernel] * 2, strides=[step.stride] * 2, pads=step.pads)
            known[step.name] = x
        return entry.op("Flatten", [x], f"{name}.flat")

    def _conv(self, entry, step, layer, x, added, at):
        weights = [entry.weight(f"{at}.weight", layer.conv.weight)]
        weights += [entry.weight(f"{at}.bias", layer.conv.bias)] if step.norm is None else []
        groups = layer.conv.groups
        x = entry.op("Conv", [x, *weights], f"{at}.conv", kernel_shape=[step.kernel] * 2, strides=[step.stride] * 2, pads=step.pads, group=groups)
        if step.norm is not None:
            norm = layer.batch_norm
            parts = {"scale": norm.weight, "shift": norm.bias, "mean": norm.running_mean, "var": norm.running_var}
            x = entry.op("BatchNormalization", [x, *(entry.weight(f"{at}.{part}", value) for part, value in parts.items())], f"{at}.norm", epsilon=step.norm)
        if added is not None:
            x = entry.op("Add", [x, added], f"{at}.sum")
        if step.activation == "Relu6":
            return entry.op("Clip", [x, entry.scalar("zero", 0.0), entry.scalar("six", 6.0)], f"{at}.clip")
        return entry.op(step.activation, [x], f"{at}.relu") if step.activation else x


class Images(nn.Module):
    """Policy of camera encoders, a layer for their features, and an MLP over them and the observation."""

    def __init__(self, cameras, hidden):
        super().__init__()
        self.normalizer = Normalizer(len(common.ENVIRONMENT["observation"]))
        self.encoders = nn.ModuleList(Encoder(camera) for camera in cameras)
        features = [encoder.features() for encoder in self.encoders]
        widths = [sum(features), *hidden]
        self.dense = nn.ModuleList(nn.Linear(k, n) for k, n in zip(widths, widths[1:]))
        self.first = nn.Linear(len(common.ENVIRONMENT["observation"]), hidden[-1])
        self.last = nn.Linear(hidden[-1], len(common.ENVIRONMENT["action"]))

    def forward(self, observations, *frames):
        """Computes the actions: observations [T, O], frames of each camera -> actions [T, A]."""
        x = torch.cat([encoder(rows) for encoder, rows in zip(self.encoders, frames)], 1)
        for layer in self.dense:
            x = functional.relu(layer(x))
        return self.last(torch.tanh(self.first(self.normalizer(observations)) + x))


def randomize(policy, seed):
    """Sets random weights with which the features keep their size from layer to layer, and follow the frame."""
    generator = torch.Generator().manual_seed(seed)
    random_policy.draw_weights(policy, generator)
    random_policy.place_normalizer(policy.normalizer, common.ENVIRONMENT["observation"])
    spread(policy, generator)
    with torch.no_grad():
        policy.last.weight.mul_(0.5)
    return policy.eval()


def spread(network, generator):
    """Sets random weights of convolutions and batch norms with which values keep their size from layer to layer."""
    draw = lambda tensor: torch.randn(tensor.shape, generator=generator)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.copy_(draw(module.weight) * (2 / module.weight[0].numel()) ** 0.5)
            elif isinstance(module, nn.BatchNorm2d):
                module.weight.copy_(1 + 0.1 * draw(module.weight))
                module.running_mean.copy_(0.1 * draw(module.running_mean))
                module.running_var.copy_(0.8 + 0.4 * torch.rand(module.running_var.shape, generator=generator))


def build(policy, sizes):
    graph = graphs.Graph()
    entry = graphs.Entry(graph, plain.ENTRY)
    observation = entry.input("observation", [1, sizes.observation])
    features = [encoder.build(entry) for encoder in policy.encoders]
    x = features[0] if len(features) == 1 else entry.op("Concat", features, "features", axis=1)
    for number, layer in enumerate(policy.dense):
        weight, bias = (entry.weight(f"policy.dense{number}.{part}", getattr(layer, part)) for part in ("weight", "bias"))
        x = entry.op("Relu", [entry.gemm(x, weight, bias, f"dense{number}")], f"dense{number}.relu")
    centred = entry.centred(observation, policy.normalizer, "observation_centred")
    weight = entry.weight("policy.first.weight", graphs.fold_std(policy.first.weight, policy.normalizer))
    seen = entry.gemm(centred, weight, entry.weight("policy.first.bias", policy.first.bias), "first")
    x = entry.op("Tanh", [entry.op("Add", [seen, x], "joined")], "joined.tanh")
    entry.gemm(x, entry.weight("policy.last.weight", policy.last.weight), entry.weight("policy.last.bias", policy.last.bias), "action")
    entry.output("action", [1, policy.last.out_features])
    return graph.model("plain")


def contract(cameras, seed, kind):
    frames = [contracts.camera(camera.name, camera.shape) for camera in cameras]
    return plain.contract(None, seed, kind, more=frames)


def lorel(widths):
    """Lists eight convolutions with kernels of 4 and strides 2 and 1 by turns, as the paper's encoder of 64x64 frames."""
    return tuple(Conv(width, 4, 2 - number % 2, (1, 1, 1, 1)) for number, width in enumerate(widths))


def _inverted(channels, outputs, kernel, stride, expand, side, before, name):
    """Lists the steps of a block of a mobile network, with TensorFlow's "same" padding for an input of so many rows and columns."""
    wide, total = channels * expand, max((-(-side // stride) - 1) * stride + kernel - side, 0)
    pads = (total // 2, total // 2, total - total // 2, total - total // 2)
    add = before if stride == 1 and channels == outputs else None
    steps = [Conv(wide, 1, norm=1e-3, activation="Relu6")] if expand > 1 else []
    return [*steps, Conv(wide, kernel, stride, pads, True, 1e-3, "Relu6"), Conv(outputs, 1, norm=1e-3, activation=None, add=add, name=name)]


def lite0(whole=False):
    """Lists the steps of EfficientNet-Lite0 up to its block 10, then means over a grid of 4x4 parts that overlap; or of the whole network
    without its classifier."""
    rows = [(1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112)]
    rows += [(4, 5, 2, 6, 192), (1, 3, 1, 6, 320)] if whole else []
    steps, channels, side, before = [Conv(32, 3, 2, (0, 0, 1, 1), norm=1e-3, activation="Relu6", name="stem")], 32, 112, "stem"
    for row, (repeats, kernel, stride, expand, outputs) in enumerate(rows):
        for repeat in range(repeats):
            name, step = f"block{row}.{repeat}", stride if repeat == 0 else 1
            steps += _inverted(channels, outputs, kernel, step, expand, side, before, name)
            channels, side, before = outputs, -(-side // step), name
    if whole:
        return tuple([*steps, Conv(1280, 1, norm=1e-3, activation="Relu6"), Pool("GlobalAveragePool")])
    return tuple([*steps, Pool("AveragePool", 5, 3)])


def resnet18():
    """Lists the steps of ResNet18 without its classifier."""
    conv = lambda outputs, kernel, stride=1, **more: Conv(outputs, kernel, stride, (kernel // 2,) * 4, norm=1e-5, **more)
    steps, channels, before = [conv(64, 7, 2), Pool("MaxPool", 3, 2, (1, 1, 1, 1), "pool")], 64, "pool"
    for outputs in (64, 128, 256, 512):
        for half in ("a", "b"):
            name, stride = f"{outputs}{half}", 1 if outputs == channels else 2
            added = before
            if stride == 2:
                added = f"{name}.shortcut"
                steps.append(conv(outputs, 1, stride, source=before, name=added, activation=None))
            steps += [conv(outputs, 3, stride, source=before), conv(outputs, 3, add=added, name=name)]
            channels, before = outputs, name
    return tuple([*steps, Pool("GlobalAveragePool")])


SMALL = (
    Camera("front", (64, 64), lorel((4, 4, 8, 8, 16, 16, 32, 32))),
    Camera(
        "wrist",
        (21, 16),
        (
            Conv(8, 3, 2, (0, 0, 1, 1), norm=1e-3, activation="Relu6"),
            Pool("MaxPool", 3, 2, (1, 0, 1, 1), "pool"),
            *_inverted(8, 8, 3, 1, 3, 6, "pool", "block"),
            Conv(12, 1, 2, source="block", norm=1e-5, name="shortcut", activation=None),
            Conv(12, 3, 2, (1, 1, 1, 1), source="block", norm=1e-5, add="shortcut"),
            Pool("AveragePool", 2, 1),
        ),
        127.0,
        128.0,
    ),
)
# For measurements: cameras, widths of the layers behind the encoder.
SIZES = {
    "lorel-encoder": ((Camera("camera", (64, 64), lorel((32, 32, 64, 64, 128, 128, 256, 256))),), (512, 512, 512, 512, 128)),
    "lite0": ((Camera("camera", (224, 224), lite0(), 127.0, 128.0),), (128,)),
    "resnet18": ((Camera("camera", (224, 224), resnet18(), 127.0, 58.0),), (128,)),
}
