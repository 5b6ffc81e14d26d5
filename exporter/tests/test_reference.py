"""Tests reference rollouts: the PyTorch policy out of a bundle, its full-sequence forward, and what ends and continues a run."""

import base64
import json

import numpy as np
import pytest
import torch
from safetensors.numpy import load

from lads_exporter import config, contract as contracts, questions, reference, training, weights


def contract_of(model):
    return json.loads({row.key: row.value for row in model.metadata_props}["lads.contract"])


def words(encoded):
    return [torch.from_numpy(row.words) for row in encoded.instructions]


def test_a_bundle_gives_the_networks_back(policy):
    _, encoded, lads, model = policy
    contract = contracts.of(model)
    trained, loaded = weights.from_lads(lads), weights.from_bundle(model, contract)
    torch.manual_seed(0)
    observations = trained.normalizer.mean + torch.randn(1, 7, contracts.observation(contract)["shape"][0])
    actions = torch.rand(1, 7, contracts.action(contract)["shape"][0]) - 0.5
    word = words(encoded)[0]
    with torch.no_grad():
        logits = [acting.high_level([word], acting.normalizer(observations), actions) for acting in (trained, loaded)]
        low = [acting.low_level(acting.normalizer(observations[0]), acting.codes[:1].expand(7, -1)) for acting in (trained, loaded)]
    assert torch.equal(trained.codes, loaded.codes)
    assert (logits[0] - logits[1]).abs().max() < 1e-5
    assert (low[0] - low[1]).abs().max() < 1e-5


def test_the_full_sequence_gives_the_golden_episode(policy):
    _, encoded, _, model = policy
    contract = contracts.of(model)
    golden = load(base64.b64decode({row.key: row.value for row in model.metadata_props}["lads.golden"]))
    acting = reference.FullSequencePolicy(weights.from_bundle(model, contract), contract, words(encoded))
    acting.start(int(golden["instruction"][0]))
    actions = np.stack([acting.act(observation) for observation in golden["channel.observation"]])
    assert acting.plans == golden["selected"][:: contracts.period(contract)].tolist()
    assert np.abs(actions - golden["actions"]).max() < 1e-4


def test_the_purpose_is_what_it_is_for(tiny):
    contract = contracts.of(tiny[3])
    purpose = reference.purpose_sha256(contract)
    words = [row | {"shape": [99, 8]} if row["role"] == "instruction" else row for row in contract["channels"]]
    refusing = contract["language"] | {"acceptance": {"threshold": 0.5}}
    for same in ({"family": {"kind": "lang_dt"}}, {"channels": words}, {"language": refusing}):
        assert reference.purpose_sha256(contract | same) == purpose
    meant = [row | {"reference": "something else"} if row["role"] == "action" else row for row in contract["channels"]]
    for other in ({"control_period_s": 2 * contract["control_period_s"]}, {"channels": meant}, {"evaluation": {}}):
        assert reference.purpose_sha256(contract | other) != purpose


def test_only_the_bundles_own_run_is_rolled_out(policy, monkeypatch):
    setting, encoded, lads, model = policy
    contract = contracts.of(model)
    saved = {"identity": {"dataset_sha256": contract["provenance"]["dataset_sha256"]}, "networks": lads.state_dict()}
    monkeypatch.setattr(training, "load_run", lambda folder: (saved, setting))
    monkeypatch.setattr(reference.language, "encode", lambda language, texts: encoded)
    acting, source = reference._acting(model, contract, "run")
    assert source == "the run's checkpoint" and torch.equal(acting.codes, lads.codebook.codes)
    # The same plans with another high level are another run.
    saved["networks"] = {name: value.clone() for name, value in lads.state_dict().items()}
    saved["networks"]["high_level.head.weight"][0, 0] += 1
    with pytest.raises(config.UserError, match="run is not the run that the bundle was exported from"):
        reference._acting(model, contract, "run")


class Bench:
    """Environment of a few steps of noise."""

    ID, VERSION, MAX_STEPS = "tiny-bench", "1", 9
    SUB_TASKS = ["drawer", "lamp", "lever"]

    def __init__(self, noise):
        self.numbers = None

    def versions(self):
        return {"bench": "1"}

    def max_steps(self, split):
        return self.MAX_STEPS

    def reset(self, entropy, commanded):
        self.numbers, self.steps, self.completions = np.random.default_rng(entropy), 0, {}
        return self._observe()

    def step(self, action):
        self.steps += 1
        if self.steps == 5:
            self.completions["lamp"] = 5
        return self._observe()

    def _observe(self):
        self.last = self.numbers.uniform(-0.05, 0.05, 5)
        return self.last

    def succeeded(self, commanded):
        return all(task in self.completions for task in commanded)

    def state(self):
        return self.last.copy()

    def close(self):
        pass


@pytest.fixture
def bundle(tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(reference.official.ENVIRONMENTS, "tiny-bench", Bench)
    path = tmp_path / "tiny.onnx"
    path.write_bytes(tiny[3].SerializeToString())
    return path


def test_an_interrupted_run_continues(bundle, tmp_path, monkeypatch):
    whole, resumed = tmp_path / "whole.json", tmp_path / "resumed.json"
    reference.write(bundle, whole, episodes=2, traced=1)
    step, left = Bench.step, [40]

    def interrupted(self, action):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return step(self, action)

    monkeypatch.setattr(Bench, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reference.write(bundle, resumed, episodes=2, traced=1)
    assert not resumed.exists()
    monkeypatch.setattr(Bench, "step", step)
    reference.write(bundle, resumed, episodes=2, traced=1)
    assert resumed.read_text() == whole.read_text()
    assert [path.name for path in tmp_path.glob("*.progress")] == []
    read = json.loads(whole.read_text())
    rows = [row for instruction in read["instructions"] for row in instruction["episodes"]]
    assert all(("trace" in row) == (row["episode"] < 1) and row["steps"] in (5, 9) for row in rows)
    assert all(len(row["plans"]) == len(row["margins"]) for row in rows)


def test_refusals(bundle, tmp_path):
    with pytest.raises(config.UserError, match="traced"):
        reference.write(bundle, tmp_path / "r.json", episodes=1, traced=2)
    with pytest.raises(config.UserError, match="not a bundle"):
        reference.write(__file__, tmp_path / "r.json")


def test_a_completed_reference_is_the_one_that_is_made_whole(bundle, tmp_path):
    whole, old = tmp_path / "whole.json", tmp_path / "old.json"
    reference.write(bundle, whole, episodes=2, traced=1)
    made = json.loads(whole.read_text())
    assert made["float_noise"]["logit"] > 0 and made["contract"]["family"]["decision"]["rule"] == "argmax"
    stripped = {key: value for key, value in made.items() if key not in ("contract", "float_noise")} | {"format_version": 1}
    traces = [row["trace"] for instruction in stripped["instructions"] for row in instruction["episodes"] if "trace" in row]
    kept = [(trace.pop("logits"), trace.pop("encoded"), trace.pop("encoded_margins")) for trace in traces]
    assert all(logits for logits, _, _ in kept) and any(encoded for _, encoded, _ in kept)
    old.write_text(json.dumps(stripped))
    questions.complete(bundle, old)
    completed = json.loads(old.read_text())
    assert completed.pop("logits_from") == "the bundle's initializers"
    again = [row["trace"] for instruction in completed["instructions"] for row in instruction["episodes"] if "trace" in row]
    for trace, (logits, encoded, _) in zip(again, kept, strict=True):
        numbers = [np.frombuffer(base64.b64decode(text), "<f4") for text in (trace.pop("logits"), logits)]
        assert np.abs(numbers[0] - numbers[1]).max() < 1e-5 and trace.pop("encoded") == encoded
        trace.pop("encoded_margins")
    assert completed["contract"] == made["contract"] and completed["format_version"] == made["format_version"]
    assert completed["instructions"] == stripped["instructions"]


def test_a_reference_of_another_policy_is_not_completed(bundle, tmp_path):
    file = tmp_path / "r.json"
    reference.write(bundle, file, episodes=1, traced=1)
    made = json.loads(file.read_text())
    trace = made["instructions"][0]["episodes"][0]["trace"]
    actions = np.frombuffer(base64.b64decode(trace["actions"]), "<f4") + np.float32(0.01)
    trace["actions"] = base64.b64encode(actions.tobytes()).decode()
    file.write_text(json.dumps(made))
    with pytest.raises(config.UserError, match="not this policy's"):
        questions.complete(bundle, file)
    made["instructions"][0]["text"] = "something else"
    file.write_text(json.dumps(made))
    with pytest.raises(config.UserError, match="instructions are not those"):
        questions.complete(bundle, file)
