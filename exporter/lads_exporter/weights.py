"""Loads the PyTorch policy that acts: from a run's checkpoint, or back from a bundle's initializers.

A bundle holds every weight of the networks that act, so the policy can be run in PyTorch from the repository alone. Two
things are folded at export and stay folded here: the division by the observations' standard deviation (into the weights
that read observations) and batch norm (into the linear layer before it). Loaded from a checkpoint they are not folded.
Nothing else of the bundle is used: no node of its graphs but one attribute, the slope of LeakyReLU, is read.
"""

import torch
from onnx import numpy_helper
from torch import nn

from . import contract as contracts
from .config import NO_STAGE, HighLevel, Images, LowLevel, Stage, UserError
from .kinds.sighted import FrameEncoder
from .model import HighLevelPolicy, LowLevelPolicy, Normalizer


class Acting(nn.Module):
    """Networks that act: the encoder of frames of those with a camera, normaliser, high level, codes [M, D], low level. In eval mode."""

    def __init__(self, normalizer, high_level, codes, low_level, frames=None):
        super().__init__()
        if frames is not None:
            self.frames = frames
        self.normalizer, self.high_level, self.low_level = normalizer, high_level, low_level
        self.register_buffer("codes", codes)
        self.eval()


class Nearest(nn.Module):
    """High level that regresses a plan, with logits over the codes: the nearest is the largest."""

    def __init__(self, high_level, codes, project_in=None):
        super().__init__()
        self.high_level, self.project_in = high_level, project_in or nn.Identity()
        self.register_buffer("codes", codes)

    def forward(self, *history):
        return nearness(self.project_in(self.high_level(*history)), self.codes)


def nearness(regressed, codes):
    """Computes how near plans [..., D] are to codes [M, D] -> [..., M]: squared distances, negative, in the unit of `systems.folding`."""
    unit = (codes - codes.mean(0)).square().sum(1).mean().clamp(min=1e-12)
    return -(regressed[..., None, :] - codes).square().sum(-1) / unit


def from_lads(lads, regressed=False):
    """Takes the acting part of trained networks; `regressed` says that the high level regresses its plans, as those do that it projects."""
    project_in = getattr(lads, "project_in", None)
    high_level = Nearest(lads.high_level, lads.codebook.codes, project_in) if regressed or project_in else lads.high_level
    low_level = lads.acting_low_level() if hasattr(lads, "acting_low_level") else lads.low_level
    return Acting(lads.normalizer, high_level, lads.codebook.codes, low_level, getattr(lads, "frames", None))


def _tensors(model):
    named = ((row.name, row) for row in model.graph.initializer)
    return {name.removeprefix("weights/"): torch.from_numpy(numpy_helper.to_array(row).copy()) for name, row in named}


def _slope(model):
    for node in model.graph.node:
        if node.op_type == "LeakyRelu" and node.output[0].startswith("low_level/act/"):
            return next(row.f for row in node.attribute if row.name == "alpha")
    return 0.0  # two layers have no activation between them but the first's; a bundle always has one


def _lengths(contract):
    """Returns the numbers of elements that both levels read, of the observation or of a frame's features, and of the action."""
    features = contract["family"].get("features")
    return features or contracts.observation(contract)["shape"][0], contracts.action(contract)["shape"][0]


def _frame_encoder(tensors, contract):
    """Loads the encoder of frames; its layout is that of `FrameEncoder`, its sizes are the tensors'."""
    _, camera = contracts.seen(contract)
    channel, size = camera["name"], camera["shape"][:2]
    numbered = lambda stem, part: [tensors[f"{stem}.{n}.{part}"] for n in range(sum(name.startswith(f"{stem}.") and name.endswith(f".{part}") for name in tensors))]
    convolutions = list(zip(numbered(channel, "weight"), numbered(channel, "bias"), strict=True))
    dense = list(zip(numbered("observation_encoder.dense", "weight"), numbered("observation_encoder.dense", "bias"), strict=True))
    widths, hidden = ([len(bias) for _, bias in layers] for layers in (convolutions, dense))
    encoder = FrameEncoder(Images(channel, widths, hidden[:-1], hidden[-1], 0.0, 0.0, 0.0, 0.0, 0.0, Stage(**NO_STAGE)), size)
    state = {}
    for stem, layers in ((lambda n: f"convolutions.layers.{n}.conv", convolutions), (lambda n: f"dense.{n}", dense)):
        for number, (weight, bias) in enumerate(layers):
            state |= {f"{stem(number)}.weight": weight, f"{stem(number)}.bias": bias}
    encoder.load_state_dict(state)
    return encoder.eval()


def _high_level(tensors, contract):
    network, context = contract["network"], contract["context"]
    hidden = network["heads"] * network["head_dim"]
    setting = HighLevel(hidden, network["layers"], network["heads"], 0.0, context["steps"], 0.0)
    lengths = _lengths(contract)
    policy = HighLevelPolicy(setting, contract["language"]["dim"], *lengths, contract["family"]["codebook"]["size"])
    # As stored for `linear`, [k, n]; PyTorch wants [n, k]. Embeddings of observation and action and the head are stored [n, k].
    state = {"embed_timestep.weight": tensors["high_level.embed_timestep"]}
    for name in ("embed_observation", "embed_action", "head"):
        state |= {f"{name}.{part}": tensors[f"high_level.{name}.{part}"] for part in ("weight", "bias")}
    linears = ["embed_word"] + [f"block.{n}.{part}" for n in range(network["layers"]) for part in ("qkv", "out", "up", "down")]
    norms = ["embed_norm", "norm"] + [f"block.{n}.{part}" for n in range(network["layers"]) for part in ("norm1", "norm2")]
    for name in linears:
        ours = name.replace("block.", "blocks.")
        state |= {f"{ours}.weight": tensors[f"high_level.{name}.weight"].T, f"{ours}.bias": tensors[f"high_level.{name}.bias"]}
    for name in norms:
        ours = name.replace("block.", "blocks.")
        state |= {f"{ours}.weight": tensors[f"high_level.{name}.scale"], f"{ours}.bias": tensors[f"high_level.{name}.bias"]}
    policy.load_state_dict(state)
    return policy.eval()


def _low_level(tensors, contract, slope):
    layers = sum(name.startswith("low_level.layer.") and name.endswith(".weight") for name in tensors)
    hidden = len(tensors["low_level.layer.0.bias"])
    observations, actions = _lengths(contract)
    policy = LowLevelPolicy(LowLevel(hidden, layers, slope, 1.0), observations, contract["family"]["codebook"]["dim"], actions)
    last = layers - 1
    state = dict(policy.state_dict())
    for ours, number in (("first", 0), ("last", last)):
        state |= {f"{ours}.{part}": tensors[f"low_level.layer.{number}.{part}"] for part in ("weight", "bias")}
    for place, norm in enumerate(policy.norms):
        # Folded already: the norm only adds the bias, because this variance and its epsilon make one.
        state[f"norms.{place}.running_var"] = torch.full_like(norm.running_var, 1.0 - norm.eps)
        state[f"middle.{place}.weight"] = tensors[f"low_level.layer.{place + 1}.weight"]
        state[f"norms.{place}.bias"] = tensors[f"low_level.layer.{place + 1}.bias"]
    policy.load_state_dict(state)
    return policy.eval()


def from_bundle(model, contract):
    """Loads the acting networks of an ONNX bundle, with the normaliser's scale and batch norm folded into their neighbours."""
    tensors = _tensors(model)
    try:
        normalizer = Normalizer(_lengths(contract)[0])
        normalizer.mean.copy_(tensors["observation_mean"])
        frames = _frame_encoder(tensors, contract) if "features" in contract["family"] else None
        slope = _slope(model)
        low_level = _low_level(tensors, contract, slope)
        return Acting(normalizer, _high_level(tensors, contract), tensors["codebook"], low_level, frames)
    except (KeyError, IndexError, ValueError, RuntimeError) as error:
        raise UserError(f"the bundle's weights are not those of a {contract['family']['kind']} policy of this exporter: {error}") from error
