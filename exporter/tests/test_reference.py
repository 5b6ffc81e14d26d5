"""Tests reference rollouts: the PyTorch policy out of a bundle, its full-sequence forward, and what ends and continues a run."""

import base64
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from safetensors.numpy import load

from lads_exporter import bundle as bundles, config, contract as contracts, frames, kinds, questions, random_policy, reference, training, twin, weights, whole


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
    acting = whole.of(model, contract, words(encoded))[0]
    acting.start(int(golden["instruction"][0]))
    actions = np.stack([acting.act(observation) for observation in golden["channel.observation"]])
    assert acting.plans == golden["selected"][:: contracts.period(contract)].tolist()
    assert np.abs(actions - golden["actions"]).max() < 1e-4


def test_noise_is_seeded_as_lads_run_does():
    # sim-harness/src/evaluation/evaluate.rs has the same numbers.
    assert [whole.noise_seed(entropy) for entropy in ([0, 1, 2], [7, 100, 49])] == [6_282_830_349_413_829, 5_255_917_235_266_557]


def test_a_reference_names_the_bundle_as_it_was_before_it_was_tuned():
    for name in ("kitchen", "kitchen-small", "lorel"):
        file, model = (Path(__file__).parents[2] / f"models/{name}{ending}" for ending in (".reference.json", ".onnx"))
        assert json.loads(file.read_text())["bundle_sha256"] == reference.untuned_sha256(onnx.load(model))


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
    monkeypatch.setattr(training, "load_run", lambda folder, *over: (saved, setting))
    monkeypatch.setattr(whole.language, "encode", lambda language, texts: encoded)
    acting, source = whole.of(model, contract, words(encoded), "run")
    assert source == "the run's checkpoint" and torch.equal(acting.codes, lads.codebook.codes)
    # The same plans with another high level are another run.
    saved["networks"] = {name: value.clone() for name, value in lads.state_dict().items()}
    saved["networks"]["high_level.head.weight"][0, 0] += 1
    with pytest.raises(config.UserError, match="run is not the run that the bundle was exported from"):
        whole.of(model, contract, words(encoded), "run")


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
    for output in (tmp_path, tmp_path / "none" / "r.json"):
        with pytest.raises(config.UserError, match="it is a folder, or lies in none"):
            reference.write(bundle, output)
    for seed in (-1, 1 << 70):
        with pytest.raises(config.UserError, match=f"--seed {seed}: must be a whole number"):
            reference.write(bundle, tmp_path / "r.json", seed=seed)
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.onnx"]


@pytest.mark.parametrize("damage", [
    lambda saved: saved.pop("networks"),
    lambda saved: saved["networks"].pop("high_level.head.weight"),
    lambda saved: saved["networks"]["high_level.head.weight"].fill_(float("nan")),
    lambda saved: saved["position"].clear(),
    lambda saved: saved["identity"].clear(),
    None,
])  # fmt: skip
def test_a_damaged_checkpoint_is_named(policy, tmp_path, damage):
    setting, encoded, lads, model = policy
    state = {name: value.clone() for name, value in lads.state_dict().items()}
    saved = {"identity": {"tables": setting.tables, "dataset_sha256": contracts.of(model)["provenance"]["dataset_sha256"]}, "networks": state, "position": {"stage": 9}}
    if damage:
        damage(saved)
        torch.save(saved, tmp_path / "checkpoint.pt")
    else:
        (tmp_path / "checkpoint.pt").write_bytes(b"hello")
    with pytest.raises(config.UserError, match="damaged|another|not those of its configuration|finite"):
        whole.of(model, contracts.of(model), words(encoded), tmp_path)


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


RENDERING = {"size": [12, 16], "view": {"camera": "front"}}
# Stands in for `lads-run frames --stream`: colours tell the state, and a state of zeros stops it.
STREAM = f"""#!{sys.executable}
import json, sys
import numpy as np

if sys.argv[3] != "tiny-bench":
    sys.exit("error: no environment is called '" + sys.argv[3] + "'")
rendering = json.load(open(sys.argv[5]))
out = sys.stdout.buffer
out.write(json.dumps({{"environment": sys.argv[3], "rendering": rendering, "positions": 5, "versions": {{"pencil": "2B"}}}}).encode() + b"\\n")
out.flush()
while state := sys.stdin.buffer.read(40):
    state = np.frombuffer(state, "<f8")
    if not state.any():
        sys.exit("error: a picture cannot be drawn: nothing to see")
    count = int(np.prod(rendering["size"])) * 3
    out.write(np.clip(128 + 2000 * np.resize(state, count) * np.sin(np.arange(count)), 0, 255).astype(np.uint8).tobytes())
    out.flush()
"""


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "lads-run"
    path.write_text(STREAM)
    path.chmod(0o755)
    return path


def on_the_bench(kind, folder, monkeypatch):
    """A random policy with a camera -> its bundle, the networks that it was made of."""
    monkeypatch.setitem(reference.official.ENVIRONMENTS, "tiny-bench", Bench)
    networks, model = kinds.export(kind)
    contract = contract_of(model)
    _, camera = contracts.seen(contract)
    camera["rendering"] = RENDERING | {"size": camera["shape"][:2]}
    contract["environment"]["id"] = "tiny-bench"
    for row in model.metadata_props:
        if row.key == "lads.contract":
            row.value = json.dumps(contract)
    path = folder / f"{kind}.onnx"
    bundles.save(model, path)
    return path, networks


@pytest.fixture
def sighted(tmp_path, monkeypatch):
    return on_the_bench("sighted", tmp_path, monkeypatch)


@pytest.fixture
def remembering(tmp_path, monkeypatch):
    """A policy that sees frames and joints, whose run is its networks -> its bundle, the networks."""
    path, networks = on_the_bench("sighted_history", tmp_path, monkeypatch)
    plain = SimpleNamespace(config=SimpleNamespace(system=SimpleNamespace(regressed=False)))
    monkeypatch.setattr(whole, "_trained", lambda *_: (networks, plain, None))
    return path, networks


def test_a_stream_of_frames_draws_and_says_why_not(program):
    renderer = frames.Renderer(program, "tiny-bench", RENDERING)
    states = np.random.default_rng(0).uniform(-0.05, 0.05, (3, 5))
    drawn = [renderer.draw(state) for state in states]
    assert drawn[0].shape == (12, 16, 3) and not np.array_equal(drawn[0], drawn[1])
    assert np.array_equal(renderer.draw(states[0]), drawn[0])
    assert renderer.versions == {"pencil": "2B"}
    with pytest.raises(config.UserError, match="5 numbers, not of 4"):
        renderer.draw(states[0, :4])
    with pytest.raises(config.UserError, match="nothing to see"):
        renderer.draw(np.zeros(5))
    with pytest.raises(config.UserError, match="no environment is called 'other'"):
        frames.Renderer(program, "other", RENDERING)
    with pytest.raises(config.UserError, match="no-such.*--lads-run"):
        frames.Renderer(program.with_name("no-such"), "tiny-bench", RENDERING)


def test_a_camera_s_policy_comes_back_out_of_its_bundle(sighted):
    path, networks = sighted
    model = onnx.load(path)
    contract = contracts.of(model)
    trained, loaded = weights.from_lads(networks), weights.from_bundle(model, contract)
    drawn = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8))
    with torch.no_grad():
        assert (trained.frames(drawn[None]) - loaded.frames(drawn[None])).abs().max() < 1e-5
        assert loaded.frames(drawn[None]).shape == (1, contract["family"]["features"])
        assert torch.equal(trained.normalizer.mean, loaded.normalizer.mean)


def test_a_reference_of_a_camera_keeps_states_and_digests(sighted, program, tmp_path):
    path, _ = sighted
    file = tmp_path / "r.json"
    reference.write(path, file, episodes=2, traced=1, lads_run=program)
    made = json.loads(file.read_text())
    assert made["renderer"] == {"pencil": "2B"} and made["float_noise"]["action"] > 0
    renderer = frames.Renderer(program, "tiny-bench", RENDERING)
    for instruction in made["instructions"]:
        for episode in instruction["episodes"]:
            assert ("trace" in episode) == (episode["episode"] == 0)
        episode = instruction["episodes"][0]
        trace, steps = episode["trace"], episode["steps"]
        assert trace["observations"] == "" and trace["logits"] and "encoded" not in trace
        read = lambda key, kind, columns: np.frombuffer(base64.b64decode(trace[key]), kind).reshape(steps, columns)
        for state, digest in zip(read("states", "<f8", 5), read("frames", "u1", frames.DIGEST), strict=True):
            assert np.array_equal(frames.digest(renderer.draw(state)), digest)
    # What is recorded is found again, and frames that are drawn otherwise are not taken for it.
    questions.complete(path, file, lads_run=program)
    assert json.loads(file.read_text())["instructions"] == made["instructions"]
    program.write_text(STREAM.replace("2000", "2001"))
    with pytest.raises(config.UserError, match="step 0: its frame is drawn otherwise here"):
        questions.complete(path, file, lads_run=program)


@pytest.mark.parametrize("kind", ["history", "sighted_history"])
def test_a_policy_with_a_window_acts_as_its_twin(kind):
    networks, model = kinds.export(kind)
    contract = contracts.of(model)
    if kind == "sighted_history":
        networks = weights.from_lads(networks)
    policy = whole.History(networks, contract, words(kinds.common.WORDS))
    runner = twin.Twin(model)
    policy.start(1)
    runner.set_instruction(1)
    steps = contract["context"]["steps"] + 3 * contracts.period(contract)  # on into a second context
    channels = random_policy.channels(contract, steps, seed=5)
    for step in range(steps):
        seen = {name: rows[step] for name, rows in channels.items()}
        action, index = runner.step(seen)
        assert np.abs(policy.act(seen if len(seen) > 1 else seen["observation"]) - action).max() < 1e-4
        assert policy.plans[-1] == index
        executed = action + np.float32(0.01)  # what was executed need not be what was wanted
        policy.actions[-1] = torch.from_numpy(executed)
        runner.executed(executed)
    assert len(set(policy.plans)) > 1


def test_a_reference_of_a_camera_and_joints_keeps_both(remembering, program, tmp_path):
    path, _ = remembering
    file = tmp_path / "r.json"
    with pytest.raises(config.UserError, match="whose layers are folded in the bundle; name the training"):
        reference.write(path, file, episodes=2, traced=1, lads_run=program)
    reference.write(path, file, run="run", episodes=2, traced=1, lads_run=program)
    made = json.loads(file.read_text())
    assert made["renderer"] == {"pencil": "2B"} and made["float_noise"]["logit"] > 0 and made["weights_from"] == "the run's checkpoint"
    joints, camera = contracts.seen(made["contract"])
    size, count = camera["shape"][:2], joints["shape"][0]
    renderer = frames.Renderer(program, "tiny-bench", RENDERING | {"size": size})
    for index, instruction in enumerate(made["instructions"]):
        trace, steps = instruction["episodes"][0]["trace"], instruction["episodes"][0]["steps"]
        read = lambda key, kind, columns: np.frombuffer(base64.b64decode(trace[key]), kind).reshape(steps, columns)
        # The bench shows its state as it is, so the joints are its first elements as the policy was given them.
        states, observed = read("states", "<f8", 5), read("observations", "<f4", count)
        assert np.array_equal(observed, states[:, :count].astype(np.float32))
        runner = twin.Twin(onnx.load(path))
        runner.set_instruction(index)
        for state, digest, own, action in zip(states, read("frames", "u1", frames.DIGEST), observed, read("actions", "<f4", 3), strict=True):
            drawn = renderer.draw(state)
            assert np.array_equal(frames.digest(drawn), digest)
            assert np.abs(runner.step({"camera": drawn, "observation": own})[0] - action).max() < 1e-4
        assert trace["logits"] and "encoded" not in trace
    questions.complete(path, file, run="run", lads_run=program)
    assert json.loads(file.read_text())["instructions"] == made["instructions"]


@pytest.mark.parametrize("damage", [
    lambda trace: trace.update(observations=""),
    lambda trace: trace.pop("observations"),
    lambda trace: trace.update(observations=trace["observations"][:-8]),
    lambda trace: trace.update(observations="not base64"),
    lambda trace: trace.update(observations=base64.b64encode(np.full(36, np.nan, "<f4").tobytes()).decode()),
])  # fmt: skip
def test_damaged_joints_are_refused(remembering, program, tmp_path, damage):
    path, _ = remembering
    file = tmp_path / "r.json"
    reference.write(path, file, run="run", episodes=1, traced=1, lads_run=program)
    made = json.loads(file.read_text())
    damage(made["instructions"][1]["episodes"][0]["trace"])
    file.write_text(json.dumps(made))
    with pytest.raises(config.UserError, match="close, episode 0: its observations are not the 36 finite numbers"):
        questions.complete(path, file, run="run", lads_run=program)


def test_a_camera_without_a_rendering_is_refused(tmp_path, monkeypatch, program):
    monkeypatch.setitem(reference.official.ENVIRONMENTS, "tiny-bench", Bench)
    _, model = kinds.export("sighted")
    contract = contract_of(model) | {"environment": {"id": "tiny-bench", "version": "1"}}
    for row in model.metadata_props:
        if row.key == "lads.contract":
            row.value = json.dumps(contract)
    bundles.save(model, tmp_path / "s.onnx")
    with pytest.raises(config.UserError, match="does not say how its frames are drawn"):
        reference.write(tmp_path / "s.onnx", tmp_path / "r.json", lads_run=program)
