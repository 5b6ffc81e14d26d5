"""Adds to a reference what it records beside its rollouts, so that more than actions can be compared: contract, logits, encodings, noise.

All of it is computed from the traces, whose observations and executed actions are asked again: the logits of every decision,
the plan that the trajectory encoder sees in every whole segment, and what float noise on all weights does to the reference's own
answers, which is what a verification must allow. So a reference that was made without can be completed, with no environment.
"""

import base64
import json
import tempfile
from pathlib import Path

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import numpy_helper

from . import config, contract as contracts, frames, whole
from .bundle import write_atomically

# Relative size of the noise: some rounding errors of 32-bit floats, and what another order of sums makes of them.
NOISE, DRAWS = 1e-6, 3
# A recorded action or plan that the weights do not give is another policy's.
SAME_ACTION, SAME_PLAN = 1e-4, 1e-3


def _text(rows, kind):
    return base64.b64encode(np.stack(rows).astype(kind).tobytes()).decode()


def _numbers(text, kind, columns):
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, columns)


def _decoded(text):
    try:
        return base64.b64decode(text)
    except ValueError:  # not base64
        return b""


def _traced(rows):
    """Yields (index of the instruction, episode) of every trace."""
    return [(index, row) for index, instruction in enumerate(rows) for row in instruction["episodes"] if "trace" in row]


class Shown:
    """What the policy was shown in each trace: recorded observations, and frames of the recorded states, drawn once into a temporary file."""

    def __init__(self, rows, contract, renderer):
        self.frames = {}
        self.vector, self.camera = contracts.seen(contract)
        for index, episode in _traced(rows):
            count = episode["steps"] * self.vector["shape"][0] if self.vector else 0
            recorded = _decoded(episode["trace"].get("observations", ""))
            if len(recorded) != 4 * count or not np.isfinite(np.frombuffer(recorded, "<f4")).all():
                where = f"{rows[index]['id']}, episode {episode['episode']}"
                raise config.UserError(f"{where}: its observations are not the {count} finite numbers that the policy observes; make the reference again")
        if renderer is None:
            return
        traced = [(index, episode, _states(episode)) for index, episode in _traced(rows)]
        shape = (sum(len(states) for *_, states in traced), *renderer.shape)
        self.file = tempfile.NamedTemporaryFile()
        drawn, at = np.memmap(self.file.name, np.uint8, "w+", shape=(max(1, shape[0]), *shape[1:])), 0
        for index, episode, states in traced:
            known = _numbers(episode["trace"]["frames"], "u1", frames.DIGEST)
            first = at
            for state, digest in zip(states, known, strict=True):
                drawn[at] = renderer.draw(state)
                if not np.array_equal(frames.digest(drawn[at]), digest):
                    where = f"{rows[index]['id']}, episode {episode['episode']}, step {at - first}"
                    raise config.UserError(f"{where}: its frame is drawn otherwise here than when it was recorded; make the reference again")
                at += 1
            self.frames[index, episode["episode"]] = drawn[first:at]

    def of(self, index, episode):
        """Returns what was shown at each step: {channel: [steps, ...]}."""
        found = {}
        if self.vector:
            found[self.vector["name"]] = self.observations(episode)
        if self.camera:
            found[self.camera["name"]] = self.frames[index, episode["episode"]]
        return found

    def observations(self, episode):
        """Returns the observed vectors [steps, O]."""
        return _numbers(episode["trace"]["observations"], "<f4", self.vector["shape"][0])


def _states(episode):
    return _numbers(episode["trace"]["states"], "<f8", len(episode["final_state"]))


def _ask(policy, shown, index, episode):
    """Asks a policy what a trace's policy was asked -> logits per decision, actions [steps, A]."""
    trace = episode["trace"]
    policy.start(index, episode.get("noise_seed"))
    actions, seen = [], shown.of(index, episode)
    for step, done in enumerate(_numbers(trace["actions"], "<f4", len(policy.low))):
        actions.append(policy.act({name: np.array(rows[step]) for name, rows in seen.items()}))
        policy.actions[-1] = torch.from_numpy(done.copy())
    return policy.logits, np.stack(actions)


def _half_range(difference):
    """Computes the largest of differences once the constant is subtracted that makes it smallest."""
    return float(difference.max() - difference.min()) / 2


@torch.no_grad()
def float_noise(policy, shown, rows):
    """Measures the effect of noise on all weights on a policy's answers -> the largest differences of an action, of a logit, and of an element
    of a plan that is a vector."""
    generator = torch.Generator().manual_seed(0)
    largest = {"relative": NOISE, "action": 0.0, "logit": 0.0}
    answers = {id(episode): (*_ask(policy, shown, index, episode), policy.vectors) for index, episode in _traced(rows)}
    for _ in range(DRAWS):
        noisy = whole.disturbed(policy, NOISE, generator)
        for index, episode in _traced(rows):
            logits, actions, vectors = answers[id(episode)]
            other_logits, other_actions = _ask(noisy, shown, index, episode)
            for a, b in zip(logits, other_logits, strict=True):
                largest["logit"] = max(largest["logit"], _half_range(a - b))
            if vectors:
                difference = float((torch.stack(vectors) - torch.stack(noisy.vectors)).abs().max())
                largest["plan_vector"] = max(largest.get("plan_vector", 0.0), difference)
            # Another plan has other actions; that is the logits' matter.
            kept = np.array([bool(a.argmax() == b.argmax()) for a, b in zip(logits, other_logits)] + [True])
            same = kept[np.searchsorted(noisy.decided_at, np.arange(len(actions)), side="right") - 1]
            if same.any():
                largest["action"] = max(largest["action"], float(np.abs(actions - other_actions)[same].max()))
    return {key: float(f"{value:.3g}") for key, value in largest.items()}


class Encoder:
    """Trajectory encoder of a bundle in PyTorch, made from its initializers."""

    def __init__(self, model, codes):
        named = {row.name.removeprefix("weights/"): torch.from_numpy(numpy_helper.to_array(row).copy()) for row in model.graph.initializer}
        self.relative = any(name.endswith("encoder.first") for name in named)
        self.mean, self.codes = named["observation_mean"], codes
        gates = lambda array: torch.cat([array.chunk(4)[gate] for gate in (0, 2, 3, 1)])  # ONNX: i, o, f, c; PyTorch: i, f, c, o
        inputs, recurrent = (gates(named[f"encoder.lstm.{part}"][0]) for part in ("input", "recurrent"))
        biases = [gates(half) for half in named["encoder.lstm.bias"][0].chunk(2)]
        self.weights = [inputs, recurrent, *biases]
        self.hidden = recurrent.shape[1]
        names = sorted({int(name.split(".")[2]) for name in named if name.startswith("encoder.mlp.")})
        self.mlp = [(named[f"encoder.mlp.{n}.weight"], named[f"encoder.mlp.{n}.bias"]) for n in names]
        slopes = [row.f for node in model.graph.node if node.op_type == "LeakyRelu" and node.output[0].startswith("trajectory_encoder/") for row in node.attribute if row.name == "alpha"]
        self.slope = slopes[0] if slopes else 0.01

    @torch.no_grad()
    def plans(self, observations, actions):
        """Encodes segments [n, H, O], [n, H, A] -> nearest code [n], and by how much farther the second is, relative to the nearest's
        squared distance."""
        observations, actions = torch.from_numpy(observations.copy()), torch.from_numpy(actions.copy())
        shown = observations - (observations[:, :1] if self.relative else self.mean)
        start = torch.zeros(1, len(shown), self.hidden)
        joined = torch.cat([shown, actions], -1)
        x = torch._VF.lstm(joined, (start, start), self.weights, True, 1, 0.0, False, False, True)[0][:, -1]
        for number, (weight, bias) in enumerate(self.mlp):
            x = F.linear(x, weight, bias)
            if number + 1 < len(self.mlp):
                x = F.leaky_relu(x, self.slope)
        distance = (x[:, None] - self.codes[None]).square().sum(-1)
        near = distance.topk(min(2, distance.shape[1]), largest=False).values
        margins = (near[:, -1] - near[:, 0]) / near[:, 0].clamp(min=1e-12)
        return distance.argmin(-1).tolist(), [float(f"{margin:.4g}") for margin in margins.tolist()]


@torch.no_grad()
def add(head, rows, model, contract, policy, renderer=None):
    """Adds contract and noise to a reference's heading, logits and encodings to its traces; refuses traces of another policy.

    `renderer` draws again what a policy with a camera saw.
    """
    shown = Shown(rows, contract, renderer)
    horizon = head["horizon"]
    try:
        encoder = Encoder(model, policy.codes) if policy.codes is not None else None
    except KeyError:
        encoder = None  # a bundle without one
    for index, episode in _traced(rows):
        logits, actions = _ask(policy, shown, index, episode)
        trace, where = episode["trace"], f"{rows[index]['id']}, episode {episode['episode']}"
        done = _numbers(trace["actions"], "<f4", len(policy.low))
        if [int(row.argmax()) for row in logits] != episode["plans"] and min(episode["margins"], default=0) > SAME_PLAN:
            raise config.UserError(f"{where}: the recorded plans are not this policy's; make the reference again")
        if policy.plans == episode["plans"] and np.abs(actions - done).max(initial=0) > SAME_ACTION:
            raise config.UserError(f"{where}: the recorded actions are not this policy's; make the reference again")
        if logits:
            trace["logits"] = _text([row.numpy() for row in logits], "<f4")
        segments = len(done) // horizon if encoder else 0
        if segments:
            cut = lambda steps: steps[: segments * horizon].reshape(segments, horizon, -1)
            trace["encoded"], trace["encoded_margins"] = encoder.plans(cut(shown.observations(episode)), cut(done))
        elif encoder:
            trace["encoded"], trace["encoded_margins"] = [], []
    head["contract"] = contract
    head["float_noise"] = float_noise(policy, shown, rows)


def complete(bundle, path, run=None, over=(), lads_run="target/release/lads-run"):
    """Adds to the reference at `path`, made by an earlier version, what it does not record; its rollouts stay as they are."""
    from . import reference

    model = onnx.load(bundle)
    contract = json.loads({row.key: row.value for row in model.metadata_props}["lads.contract"])
    head = json.loads(Path(path).read_text())
    rows = head.pop("instructions")
    if [row["text"] for row in rows] != [row["text"] for row in contract["instructions"]]:
        raise config.UserError(f"{path}: the instructions are not those of {bundle}; name the bundle that it is of")
    torch.set_num_threads(1)
    policy, weights_from = whole.of(model, contract, reference._words(model, contract)[0], run, over)
    renderer = reference.renderer_of(contract, lads_run)
    add(head, rows, model, contract, policy, renderer)
    if renderer:
        renderer.close()
    head["purpose_sha256"] = reference.purpose_sha256(contract)
    head["format_version"] = reference.FORMAT_VERSION
    head["logits_from"] = weights_from
    write_atomically(path, reference._text(head, rows).encode())
