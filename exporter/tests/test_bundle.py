"""The exported graphs against PyTorch, and the file against its contract."""

import base64
import json

import numpy as np
import onnx
import pytest
import torch
from safetensors.numpy import load as load_safetensors

from lads_exporter import bundle, random_policy
from lads_exporter.codebook import nearest
from lads_exporter.config import UserError
from lads_exporter.replay import ENTRIES, Bundle, extract


def properties(model):
    return {row.key: row.value for row in model.metadata_props}


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
    runner = Bundle(model)
    for index, known in enumerate(encoded.instructions):
        found = runner.run("instruction/lookup", {"id": np.array([index])})
        length = int(found["length"][0])
        assert length == len(known.words) <= encoded.max_words
        assert np.array_equal(found["words"][0, :length], known.words)
        assert not found["words"][0, length:].any()
    for index, code in enumerate(lads.codebook.codes):
        assert np.array_equal(runner.run("codebook/lookup", {"index": np.array([index])})["plan"][0], code.numpy())


@torch.no_grad()
def test_low_level_and_encoder(policy):
    setting, _, lads, model = policy
    runner, horizon = Bundle(model), setting.config.encoder.horizon
    observations = random_policy.observations(setting, horizon, seed=5)
    actions = np.random.default_rng(0).uniform(-1, 1, (horizon, setting.action_len)).astype(np.float32)
    normed = lads.normalizer(torch.from_numpy(observations))
    plans = lads.codebook.codes[torch.arange(horizon) % len(lads.codebook.codes)]
    expected = lads.low_level(normed, plans)
    for t in range(horizon):
        got = runner.run("low_level/act", {"observation": observations[t : t + 1], "plan": plans[t : t + 1].numpy()})
        assert largest(got["action"], expected[t : t + 1]) <= 1e-5
    got = runner.run("trajectory_encoder/encode", {"observations": observations[None], "actions": actions[None]})
    latent = lads.encoder(normed[None], torch.from_numpy(actions)[None], torch.tensor([horizon]))
    assert largest(got["latent"], latent) <= 1e-5
    assert got["index"].tolist() == nearest(latent, lads.codebook.codes).tolist()


def past_of(lads, x):
    """The keys and values of every block for embedded tokens x [1, S, d], by plain PyTorch."""
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
    runner, high = Bundle(model), lads.high_level
    for index in (0, len(encoded.instructions) - 1):
        expected = past_of(lads, high.embed_norm(high.embed_word(words_of(encoded, index))[None]))
        got = runner.instruct(index)
        assert got.keys() == expected.keys()
        assert max(largest(got[name], expected[name]) for name in got) <= 1e-5


@torch.no_grad()
@pytest.mark.parametrize("instruction", [0, 3])
def test_steps_with_cache_equal_the_whole_sequence(policy, instruction):
    """280 control steps for the kitchen: logits of every step, and the cache after the last."""
    setting, encoded, lads, model = policy
    steps = setting.config.high_level.context_steps
    observations = random_policy.observations(setting, steps, seed=9)
    actions = np.random.default_rng(1).uniform(-1, 1, (steps, setting.action_len)).astype(np.float32)
    normed = lads.normalizer(torch.from_numpy(observations))[None]
    expected = lads.high_level([words_of(encoded, instruction)], normed, torch.from_numpy(actions)[None])[0]
    runner = Bundle(model)
    context = runner.instruct(instruction)
    for t in range(steps):
        logits, context = runner.advance(context, actions[t - 1] if t else None, observations[t], t)
        assert largest(logits, expected[t]) <= (1e-5 if t < 2 else 1e-4), f"step {t}"
    length = len(encoded.instructions[instruction].words) + 2 * steps - 1
    assert all(rows.shape[2] == length for rows in context.values())


def test_contract_and_flat_keys(policy):
    setting, encoded, _, model = policy
    found = properties(model)
    contract = json.loads(found["lads.contract"])
    assert contract["version"] == 1 and contract["kind"] == "lads"
    assert contract["horizon"] == setting.config.encoder.horizon
    assert [row["id"] for row in contract["instructions"]] == [row["id"] for row in setting.instructions]
    assert contract["context"] == {"words": encoded.max_words, "steps": setting.config.high_level.context_steps, "beyond": "restart"}
    assert len(contract["observation"]) == setting.observation_len and len(contract["action"]) == setting.action_len
    assert all(row["min"] < row["max"] for row in contract["observation"] + contract["action"])
    assert found["action_names"].split(",") == [row["name"] for row in contract["action"]]
    assert [float(x) for x in found["observation_min"].split(",")] == [row["min"] for row in contract["observation"]]


@torch.no_grad()
def test_golden_episode_replays_in_pytorch(policy):
    setting, encoded, lads, model = policy
    golden = load_safetensors(base64.b64decode(properties(model)["lads.golden"]))
    observations, plans, actions = (torch.from_numpy(golden[key]) for key in ("observations", "plans", "actions"))
    normed = lads.normalizer(observations)
    logits = lads.high_level([words_of(encoded, int(golden["instruction"][0]))], normed[None], actions[None])[0]
    horizon = setting.config.encoder.horizon
    assert bundle.margin(logits.numpy(), horizon) >= 0.9 * bundle.GOLDEN_MARGIN
    decided = logits[::horizon].argmax(-1).repeat_interleave(horizon)[: len(plans)]
    assert torch.equal(decided, plans)
    low, high = (torch.tensor([row[key] for row in setting.environment["action"]]) for key in ("min", "max"))
    expected = lads.low_level(normed, lads.codebook.codes[plans]).clamp(low, high)
    assert largest(actions, expected) <= bundle.GOLDEN_TOLERANCE


def test_golden_episode_replays_in_onnx_runtime(tiny):
    model = tiny[3]
    contract = json.loads(properties(model)["lads.contract"])
    golden = load_safetensors(base64.b64decode(properties(model)["lads.golden"]))
    plans, actions, _ = Bundle(model).open_loop(contract, int(golden["instruction"][0]), golden["observations"])
    assert np.array_equal(plans, golden["plans"])
    assert largest(actions, golden["actions"]) <= bundle.GOLDEN_TOLERANCE


def test_the_same_policy_gives_the_same_bytes(tiny):
    setting, encoded, _, model = tiny
    again = random_policy.export(setting, encoded, 0)[1]
    assert again.SerializeToString(deterministic=True) == model.SerializeToString(deterministic=True)


def test_close_decisions_make_no_golden_episode(tiny):
    setting, encoded, lads, model = tiny
    contract = json.loads(properties(model)["lads.contract"])
    flat = onnx.ModelProto.FromString(model.SerializeToString())
    for tensor in flat.graph.initializer:
        if tensor.name.startswith("weights/high_level.head"):
            tensor.raw_data = bytes(len(tensor.raw_data))
    with pytest.raises(UserError, match="margin"):
        bundle.golden(flat, contract, [(0, random_policy.observations(setting, 8, 0))])
