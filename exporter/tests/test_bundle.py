"""Tests the exported graphs against PyTorch, and the file against its contract."""

import base64

import numpy as np
import onnx
import pytest
import torch
from safetensors.numpy import load as load_safetensors

from lads_exporter import bundle, contract as contracts, random_policy
from lads_exporter.codebook import nearest
from lads_exporter.config import UserError
from lads_exporter.contract import properties
from lads_exporter.twin import Entry, Twin, extract, open_loop

ENTRIES = (
    "instruction/lookup",
    "high_level/instruct",
    "high_level/start",
    "high_level/step",
    "codebook/lookup",
    "low_level/act",
    "trajectory_encoder/encode",
)


def golden_of(model):
    return load_safetensors(base64.b64decode(properties(model)["lads.golden"]))


def largest(a, b):
    a, b = (x.detach().numpy() if hasattr(x, "detach") else x for x in (a, b))
    assert a.shape == b.shape
    return float(np.abs(a - b).max())


def words_of(encoded, instruction):
    return torch.from_numpy(encoded.instructions[instruction].words)


def test_checker_and_sharing(policy):
    model = policy[3]
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version == 8 and model.opset_import[0].version == 18
    stored = [(tuple(row.dims), row.raw_data) for row in model.graph.initializer if len(row.raw_data) > 64]
    assert len(stored) == len(set(stored)), "a weight is stored twice"
    prefixes = tuple(entry + "/" for entry in ENTRIES)
    for node in model.graph.node:
        assert all(name.startswith(prefixes) for name in node.output)
    symbolic = {dim.dim_param for value in model.graph.input for dim in value.type.tensor_type.shape.dim if dim.dim_param}
    assert symbolic == {"P"}


@pytest.mark.parametrize("entry", ENTRIES)
def test_each_entry_can_be_cut_out(policy, entry):
    part = extract(policy[3], entry)
    onnx.checker.check_model(part, full_check=True)
    assert all(value.name.startswith(entry + "/") for value in [*part.graph.input, *part.graph.output])


def test_lookups(policy):
    setting, encoded, lads, model = policy
    lookup, codebook = Entry(model, "instruction/lookup"), Entry(model, "codebook/lookup")
    for index, known in enumerate(encoded.instructions):
        found = lookup(id=np.array([index]))
        length = int(found["length"][0])
        assert length == len(known.words) <= encoded.max_words
        assert np.array_equal(found["words"][0, :length], known.words)
        assert not found["words"][0, length:].any()
    for index, code in enumerate(lads.codebook.codes):
        assert np.array_equal(codebook(index=np.array([index]))["plan"][0], code.numpy())


@torch.no_grad()
def test_low_level_and_encoder(policy):
    setting, _, lads, model = policy
    act, horizon = Entry(model, "low_level/act"), setting.config.encoder.horizon
    observations = random_policy.observations(setting, horizon, seed=5)
    actions = np.random.default_rng(0).uniform(-1, 1, (horizon, setting.action_len)).astype(np.float32)
    normed = lads.normalizer(torch.from_numpy(observations))
    plans = lads.codebook.codes[torch.arange(horizon) % len(lads.codebook.codes)]
    expected = lads.low_level(normed, plans)
    for t in range(horizon):
        got = act(observation=observations[t : t + 1], plan=plans[t : t + 1].numpy())
        assert largest(got["action"], expected[t : t + 1]) <= 1e-5
    got = Entry(model, "trajectory_encoder/encode")(observations=observations[None], actions=actions[None])
    latent = lads.encoder(normed[None], torch.from_numpy(actions)[None], torch.tensor([horizon]))
    assert largest(got["latent"], latent) <= 1e-5
    assert got["index"].tolist() == nearest(latent, lads.codebook.codes).tolist()


def past_of(lads, x):
    """Computes the keys and values of every block for embedded tokens x [1, S, d], by plain PyTorch."""
    out = {}
    mask = torch.triu(torch.full((1, 1, x.shape[1], x.shape[1]), -1e9), 1)
    for number, block in enumerate(lads.high_level.blocks):
        rows = block.qkv(block.norm1(x)).chunk(3, -1)
        heads = [row.view(1, x.shape[1], block.heads, -1).transpose(1, 2) for row in rows]
        out[f"past_key_values.{number}.key"], out[f"past_key_values.{number}.value"] = heads[1], heads[2]
        x = block(x, mask)
    return out


@torch.no_grad()
def test_instruct(policy):
    _, encoded, lads, model = policy
    runner, high = Twin(model), lads.high_level
    for index in (0, len(encoded.instructions) - 1):
        expected = past_of(lads, high.embed_norm(high.embed_word(words_of(encoded, index))[None]))
        runner.set_instruction(index)
        got = runner.caches["high_level"]
        assert got.keys() == expected.keys()
        assert max(largest(got[name], expected[name]) for name in got) <= 1e-5


@torch.no_grad()
@pytest.mark.parametrize("instruction", [0, 3])
def test_steps_with_cache_equal_the_whole_sequence(policy, instruction):
    """Tests 280 control steps for the kitchen: logits of every step, and the cache after the last."""
    setting, encoded, lads, model = policy
    steps = setting.config.high_level.context_steps
    observations = random_policy.observations(setting, steps, seed=9)
    actions = np.random.default_rng(1).uniform(-1, 1, (steps, setting.action_len)).astype(np.float32)
    normed = lads.normalizer(torch.from_numpy(observations))[None]
    expected = lads.high_level([words_of(encoded, instruction)], normed, torch.from_numpy(actions)[None])[0]
    runner = Twin(model)
    runner.set_instruction(instruction)
    for t in range(steps):
        runner.step(observations[t])
        runner.executed(actions[t])
        assert largest(runner.logits, expected[t]) <= (1e-5 if t < 2 else 1e-4), f"step {t}"
    length = len(encoded.instructions[instruction].words) + 2 * steps - 1
    assert all(rows.shape[2] == length for rows in runner.caches["high_level"].values())


def test_contract_and_flat_keys(policy):
    setting, encoded, _, model = policy
    found, contract = properties(model), contracts.of(model)
    assert contract["version"] == 2 and contract["family"]["kind"] == "lads"
    assert contracts.period(contract) == setting.config.encoder.horizon
    assert [row["id"] for row in contract["instructions"]] == [row["id"] for row in setting.instructions]
    assert [row["sub_tasks"] for row in contracts.splits(contract)] == [row["sub_tasks"] for row in setting.instructions]
    assert contract["context"] == {"words": encoded.max_words, "steps": setting.config.high_level.context_steps, "beyond": "restart"}
    observation, action = contracts.observation(contract), contracts.action(contract)
    assert observation["shape"] == [setting.observation_len] and action["shape"] == [setting.action_len]
    assert all(row["min"] < row["max"] for row in observation["elements"] + action["elements"])
    assert action["reference"] == setting.environment["reference"]
    assert found["action_names"].split(",") == [row["name"] for row in action["elements"]]
    assert [float(x) for x in found["observation_min"].split(",")] == [row["min"] for row in observation["elements"]]
    assert [float(x) for x in found["action_scale"].split(",")] == [row.get("scale", 1.0) for row in setting.environment["action"]]


def test_inputs_of_the_graphs_are_channels_states_or_integers(policy):
    """Tests that every name that an entry of the control loop reads is bound to something."""
    model = policy[3]
    names = {row["name"] for row in contracts.of(model)["channels"]} | {"id", "timestep", "index", "plan"}
    local = {value.name.rsplit("/", 1)[1] for value in model.graph.input}
    assert {name for name in local if not name.startswith("past_key_values.")} <= names


@torch.no_grad()
def test_golden_episode_replays_in_pytorch(policy):
    setting, encoded, lads, model = policy
    golden = golden_of(model)
    observations, plans, actions = (torch.from_numpy(golden[key]) for key in ("channel.observation", "selected", "actions"))
    normed = lads.normalizer(observations)
    logits = lads.high_level([words_of(encoded, int(golden["instruction"][0]))], normed[None], actions[None])[0]
    horizon = setting.config.encoder.horizon
    best = logits[::horizon].topk(2).values
    assert (best[:, 0] - best[:, 1]).min() >= 0.9 * bundle.GOLDEN_MARGIN
    decided = logits[::horizon].argmax(-1).repeat_interleave(horizon)[: len(plans)]
    assert torch.equal(decided, plans)
    low, high = (torch.tensor([row[key] for row in setting.environment["action"]]) for key in ("min", "max"))
    expected = lads.low_level(normed, lads.codebook.codes[plans]).clamp(low, high)
    assert largest(actions, expected) <= bundle.GOLDEN_TOLERANCE


def test_golden_episode_replays_in_onnx_runtime(tiny):
    golden = golden_of(tiny[3])
    done = open_loop(Twin(tiny[3]), int(golden["instruction"][0]), {"observation": golden["channel.observation"]}).tensors()
    assert np.array_equal(done["selected"], golden["selected"])
    assert largest(done["actions"], golden["actions"]) <= bundle.GOLDEN_TOLERANCE


def test_the_same_policy_gives_the_same_bytes(tiny):
    setting, encoded, _, model = tiny
    again = random_policy.export(setting, encoded, 0)[1]
    assert again.SerializeToString(deterministic=True) == model.SerializeToString(deterministic=True)


def test_close_decisions_make_no_golden_episode(tiny):
    setting, encoded, lads, model = tiny
    flat = onnx.ModelProto.FromString(model.SerializeToString())
    for tensor in flat.graph.initializer:
        if tensor.name.startswith("weights/high_level.head"):
            tensor.raw_data = bytes(len(tensor.raw_data))
    with pytest.raises(UserError, match="margin"):
        bundle.golden(flat, [(0, random_policy.observations(setting, 8, 0))])


def test_an_episode_is_recorded_up_to_its_first_close_decision(tiny, monkeypatch):
    setting, _, _, model = tiny
    period = setting.config.encoder.horizon
    # An episode whose first decision is clearer than a later one.
    for seed in range(50):
        seen = random_policy.observations(setting, setting.config.high_level.context_steps, seed)
        whole = open_loop(Twin(model), 0, {"observation": seen})
        later = next((number for number, lead in enumerate(whole.margins) if lead < whole.margins[0]), 0)
        if later:
            break
    monkeypatch.setattr(bundle, "LEAST_MARGIN", whole.margins[0])
    monkeypatch.setattr(bundle, "GOLDEN_MARGIN", whole.margins[0])
    golden = load_safetensors(bundle.golden(model, [(0, seen)]))
    assert len(golden["actions"]) == later * period > 0
    assert np.array_equal(golden["actions"], np.stack(whole.actions)[: later * period])
    # A collapsed codebook decides closely from the first step on: the same part of the episode is the longest clear one by its own bound.
    monkeypatch.setattr(bundle, "LEAST_MARGIN", 2 * whole.margins[0])
    monkeypatch.setattr(bundle, "CLOSE_MARGIN", whole.margins[0])
    close = load_safetensors(bundle.golden(model, [(0, seen)]))
    assert np.array_equal(close["actions"], golden["actions"])
    monkeypatch.setattr(bundle, "CLOSE_MARGIN", 2 * whole.margins[0])
    with pytest.raises(UserError, match="margin"):
        bundle.golden(model, [(0, seen)])
