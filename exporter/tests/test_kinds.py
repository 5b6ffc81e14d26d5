"""Tests random policies of every family: their contracts, the twin against the networks in PyTorch over whole episodes, the same bytes
twice."""

import json

import numpy as np
import onnx
import pytest
import torch

from lads_exporter import contract as contracts, episode, kinds, random_policy, twin
from lads_exporter.config import UserError
from lads_exporter.kinds import common

STEPS, SEED = 28, 2  # several plans of every kind
OPERATORS = {
    "Add", "ArgMin", "AveragePool", "BatchNormalization", "Cast", "Clip", "Concat", "Conv", "Div", "Exp", "Flatten", "GRU", "Gather", "Gemm", "Identity",
    "LSTM", "LayerNormalization", "LeakyRelu", "MatMul", "MaxPool", "Min", "Mul", "ReduceSum", "Relu", "Reshape", "Slice", "Softmax", "Split", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
}  # fmt: skip


class Made:
    """Networks and bundle of a kind, and an episode of its twin under one instruction."""

    def __init__(self, name):
        self.name, self.sizes = name, kinds.KINDS[name].sizes
        self.policy, self.model = kinds.export(name, SEED)
        self.contract = contracts.of(self.model)
        self.channels = random_policy.channels(self.contract, STEPS, seed=8)
        observations = self.channels.get("observation")
        self.observations = None if observations is None else torch.from_numpy(observations)
        if hasattr(self.policy, "frames"):  # its levels observe what its encoder makes of the camera's frames
            seen = [torch.from_numpy(self.channels[name]) for name in ("observation", "camera") if name in self.channels]
            with torch.no_grad():
                self.observations = self.policy.frames(*seen)
        self.words = torch.from_numpy(common.WORDS.instructions[1].words)
        self.rollout = twin.open_loop(twin.Twin(self.model), 1 if self.contract.get("instructions") else None, self.channels)
        self.actions = torch.from_numpy(np.stack(self.rollout.actions))
        self.previous = torch.cat([torch.zeros(1, self.actions.shape[1]), self.actions[:-1]])
        self.noise = [torch.from_numpy(row) for row in self.rollout.draws]

    def clip(self, actions):
        low, high = (torch.tensor(side) for side in contracts.limits(contracts.action(self.contract)))
        return actions.clamp(low, high)

    def plans(self, logits):
        """Computes the index in force at every step, from the logits of all steps [T, M]."""
        period = contracts.period(self.contract)
        return [int(logits[t - t % period].argmax()) for t in range(STEPS)]

    def chunks(self):
        """Yields (start, end) of every plan."""
        period = contracts.period(self.contract)
        return [(start, min(start + period, STEPS)) for start in range(0, STEPS, period)]


@pytest.fixture(scope="module", params=list(kinds.KINDS))
def made(request):
    return Made(request.param)


def lads(made):
    normed = made.policy.normalizer(made.observations)
    plans = made.plans(made.policy.high_level([made.words], normed[None], made.actions[None])[0])
    return plans, made.policy.low_level(normed, made.policy.codebook.codes[plans])


def sighted_history(made):
    seen = made.observations
    plans = made.plans(made.policy.high_level([made.words], seen[None], made.actions[None])[0])
    low = made.policy.acting_low_level()
    chunk = lambda start, end: low(plans[start], seen[:end], min(start, low.window), made.previous[:end], end - start)
    return plans, torch.cat([chunk(*ends) for ends in made.chunks()])


def lang_dt(made):
    return None, made.policy(made.words, made.observations, made.actions)


def lisa(made):
    plans = made.plans(made.policy.logits(made.words, made.observations))
    normed = made.policy.normalizer(made.observations)
    chunk = lambda start, end: made.policy.low_level(plans[start], start, normed[start:end], made.actions[start:end])
    return plans, torch.cat([chunk(*ends) for ends in made.chunks()])


def history(made):
    plans = made.plans(made.policy.logits(made.words, made.observations))
    normed = made.policy.normalizer(made.observations)
    low = made.policy.low_level
    chunk = lambda start, end: low(plans[start], normed[:end], min(start, low.window), made.previous[:end], end - start)
    return plans, torch.cat([chunk(*ends) for ends in made.chunks()])


def vae(made):
    mean, log_std = made.policy.plans(made.words, made.observations, made.actions)
    parts = []
    for start, end in made.chunks():
        assert [len(made.noise[t]) for t in range(start, end)] == [made.sizes.plan] + [0] * (end - start - 1)
        plan = mean[start] + log_std[start].exp() * made.noise[start]
        parts.append(made.policy.act(made.observations[start:end], plan.expand(end - start, -1)))
    return None, torch.cat(parts)


def vae_history(made):
    mean, log_std = made.policy.plans(made.words, made.observations, made.actions)
    normed, low = made.policy.normalizer(made.observations), made.policy.low_level
    plan = lambda start: mean[start] + log_std[start].exp() * made.noise[start]
    chunk = lambda start, end: low(plan(start), normed[:end], min(start, low.window), made.previous[:end], end - start)
    return None, torch.cat([chunk(*ends) for ends in made.chunks()])


def lcsd(made):
    plans = made.plans(made.policy.logits(made.words, made.observations))
    act = lambda t: made.policy.denoise(made.observations[t : t + 1], plans[t], made.noise[t].view(-1, made.sizes.action))
    return plans, torch.cat([act(t) for t in range(STEPS)])


def skilldiffuser(made):
    plans = made.plans(made.policy.logits(made.words, made.observations))
    chunk = lambda start: made.policy.chunk(made.observations[start : start + 1], plans[start], made.noise[start])
    return plans, torch.cat([chunk(start)[: end - start] for start, end in made.chunks()])


def plain(made):
    return None, made.policy(*(torch.from_numpy(rows) for rows in made.channels.values()))


WHOLE = {"lads": lads, "sighted": lads, "sighted_lang_dt": lang_dt, "sighted_lisa": lisa, "sighted_vae": vae, "frozen_lang_dt": lang_dt, "frozen_lisa": lisa, "frozen_vae_history": vae_history, "vae_history": vae_history, "sighted_history": sighted_history, "lang_dt": lang_dt, "lisa": lisa, "history": history, "vae": vae, "lcsd": lcsd, "skilldiffuser": skilldiffuser}


@torch.no_grad()
def test_the_twin_equals_the_whole_sequence_in_pytorch(made):
    plans, actions = WHOLE.get(made.name, plain)(made)
    assert made.rollout.selected == (plans or [-1] * STEPS)
    assert plans is None or len(set(plans)) > 1, "one plan throughout shows little"
    assert float((made.clip(actions) - made.actions).abs().max()) <= 1e-4
    assert float(made.actions.std(0).min()) > 0.01, "the actions hardly move"


def test_the_bundle_is_one(made):
    model, contract = made.model, made.contract
    onnx.checker.check_model(model, full_check=True)
    assert contract["version"] == 2 and contract["family"]["kind"] in contracts.FAMILIES
    assert {node.op_type for node in model.graph.node} <= OPERATORS
    stored = [(tuple(row.dims), row.raw_data) for row in model.graph.initializer if len(row.raw_data) > 64]
    assert len(stored) == len(set(stored)), "a weight is stored twice"
    assert sum(int(np.prod(row.dims)) for row in model.graph.initializer) < 100_000
    assert {"lads.contract", "lads.golden"} <= set(contracts.properties(model))


def test_the_same_seed_gives_the_same_bytes(made):
    data = lambda seed: kinds.export(made.name, seed)[1].SerializeToString(deterministic=True)
    assert data(SEED) == made.model.SerializeToString(deterministic=True) != data(SEED + 1)


def test_every_context_and_episode_begins_alike(made):
    """Tests that a restart, a reset and a new instruction put everything back; only a restart keeps the last action."""
    if "context" not in made.contract:
        pytest.skip("no context to restart")
    quiet = twin.Zero()
    runner, steps = twin.Twin(made.model, quiet), made.contract["context"]["steps"]
    channels = random_policy.channels(made.contract, steps, seed=9)
    rows = [{name: values[t] for name, values in channels.items()} for t in range(steps)]

    def play(runner=runner):
        """Returns the actions, and logits where there are any."""
        rollout = twin.Rollout(runner)
        for row in rows:
            rollout.step(row)
        return np.concatenate([np.stack(part) for part in (rollout.actions, rollout.logits) if part], 1)

    runner.set_instruction(0)
    first = play()
    fresh = twin.Twin(made.model, quiet)
    fresh.set_instruction(0)
    fresh.executed(runner.previous)
    assert np.array_equal(play(), play(fresh))
    runner.reset()
    assert np.array_equal(first, play())
    runner.set_instruction(2)
    assert not np.array_equal(first, play()), "the words change nothing"
    runner.set_instruction(0)
    assert np.array_equal(first, play())


def test_an_episode_holds_what_a_test_needs(made, tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes(made.model.SerializeToString())
    found, margin = episode.tensors(made.model, 200, seed=0)
    assert margin >= episode.MARGIN and all(len(rows) == 200 for rows in found.values())
    known = made.contract.get("instructions")
    events = found["event"].tolist()
    assert set(events) == ({-2, -1, 0, 1} if known else {-2, -1})
    assert (found["selected"] >= 0).all() == ("codebook" in made.contract["family"])
    if "context" in made.contract:
        # Contexts start anew between the events, not only with them.
        at = [t for t, event in enumerate(events) if event != episode.NOTHING] + [200]
        assert any(end - start > made.contract["context"]["steps"] for start, end in zip(at, at[1:]))
    again = episode.play(made.model, {name: found[f"channel.{name}"] for name in made.channels}, found["event"], _recorded(found))
    assert np.array_equal(again.tensors()["actions"], found["actions"])
    episode.write(path, tmp_path / "episode.safetensors", 200)
    assert (tmp_path / "episode.safetensors").stat().st_size > found["actions"].nbytes


def _recorded(found):
    if "noise" not in found:
        return None
    return twin.Recorded(np.concatenate([row[:count] for row, count in zip(found["noise"], found["draws"])]))


def test_a_full_context_is_refused_where_the_contract_says_so():
    _, model = kinds.export("lang_dt")
    contract = contracts.of(model)
    contract["context"]["beyond"] = "refuse"
    onnx.helper.set_model_props(model, {"lads.contract": json.dumps(contract)})
    runner = twin.Twin(model)
    runner.set_instruction(0)
    channels = random_policy.channels(contract, 41, seed=1)["observation"]
    for row in channels[:40]:
        runner.step(row)
    with pytest.raises(UserError, match="context of 40 control steps is full"):
        runner.step(channels[40])


def test_words_of_ones_own_are_heard():
    made = Made("lang_dt")
    spoken, known = twin.Twin(made.model), twin.Twin(made.model)
    known.set_instruction(1)
    spoken.set_instruction(common.WORDS.instructions[1].words)
    row = made.channels["observation"][0]
    assert np.array_equal(spoken.step(row)[0], known.step(row)[0])


def test_unknown_kinds_are_named():
    with pytest.raises(UserError, match="nonsense: unknown; known: lads, lang_dt"):
        kinds.export("nonsense")
