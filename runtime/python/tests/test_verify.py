"""Faithful exports are EQUIVALENT to the policy in PyTorch, and every fault of an export is DIFFERENT."""

import json
import subprocess
import sys

import gymnasium
import jsonschema
import numpy as np
import onnx
import pytest
import torch
from lads_exporter import bundle, random_policy
from lads_exporter.kinds import KINDS
from lads_exporter.twin import Twin

import environments
import lads
from conftest import PROJECT

# PyTorch's threads would only wait for each other.
torch.set_num_threads(1)


class InPyTorch:
    """A recurrent policy as PyTorch runs it, with its states carried along."""

    def __init__(self, module, limits):
        self.module, self.limits = module, limits

    def reset(self):
        self.gru = self.lstm = None

    def __call__(self, observation):
        module = self.module
        with torch.no_grad():
            x = torch.tanh(module.first(module.normalizer(torch.from_numpy(observation[None]))))
            x, self.gru = module.gru(x, self.gru)
            x, self.lstm = module.lstm(x, self.lstm)
            action = module.last(x)[0].numpy()
        return np.clip(action, *self.limits)


class InOnnxRuntime:
    """A policy with instructions and plans in ONNX Runtime, with its selections."""

    def __init__(self, model):
        self.twin = Twin(model)

    def reset(self, instruction):
        known = [row["id"] for row in self.twin.contract["instructions"]]
        self.twin.set_instruction(known.index(instruction))

    def __call__(self, observation):
        action, plan = self.twin.step(observation)
        return lads.Reply(action, plan, self.twin.logits.copy() if self.twin.fresh else None)


def drawn(made):
    """A policy with random weights, the same ones every time."""
    torch.manual_seed(0)
    return made.policy(made.sizes, 0)


def exported(kind, tmp_path, spoil=lambda policy: None, change=lambda contract: None):
    """Returns a policy in PyTorch and its opened export; `spoil` is a fault of the networks on the way, `change` one of the contract."""
    made = KINDS[kind]
    policy, spoiled = drawn(made), drawn(made)
    with torch.no_grad():
        spoil(spoiled)
    contract = made.contract(made.sizes, 0)
    change(contract)
    known = len(contract.get("instructions", []))
    candidates = ((n % known if known else None, random_policy.channels(contract, made.sizes.steps, n)) for n in range(1, 200))
    model = bundle.seal(made.build(spoiled, made.sizes), contract, candidates)
    path = tmp_path / f"{kind}.onnx"
    onnx.save(model, path)
    return policy, lads.open(path), model


def recurrent(tmp_path, episodes=5, **faults):
    policy, opened, _ = exported("recurrent", tmp_path, **faults)
    action = opened.contract.action.elements
    limits = np.array([[element.min for element in action], [element.max for element in action]], np.float32)
    return lads.verify(InPyTorch(policy, limits), opened.controller(), environments.Servo, episodes=episodes, traced=5, reference_name="PyTorch")


def test_a_faithful_export_is_equivalent(tmp_path):
    found = recurrent(tmp_path, episodes=70)
    assert found.verdict == "EQUIVALENT", str(found)
    data = found.data
    assert data["policy"]["compared_steps"] == 5 * 40 and data["policy"]["largest_action_difference"] < 1e-5
    assert data["environment"]["identical_bits"] and data["environment"]["states"] == 5 * 41
    assert data["rollouts"]["episodes"] == 70 and data["contract"]["fields"] == ["control_period_s"]
    assert data["reference"]["weights_from"] == "PyTorch" and data["setting"]["environment"] == "Servo"


def wrong_normalizer(policy):
    policy.normalizer.mean += 0.05 * policy.normalizer.std


def swapped_observations(policy):
    policy.first.weight[:, [0, 1]] = policy.first.weight[:, [1, 0]]


def swapped_actions(policy):
    policy.last.weight[[0, 1]] = policy.last.weight[[1, 0]]
    policy.last.bias[[0, 1]] = policy.last.bias[[1, 0]]


def lost_state(policy):
    policy.gru.weight_hh_l0.zero_()
    policy.gru.bias_hh_l0.zero_()
    policy.lstm.weight_hh_l0.zero_()


def half_rate(contract):
    contract["control_period_s"] *= 2


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"spoil": wrong_normalizer}, "the policy answers otherwise in 5 of 5 replayed episodes"),
        ({"spoil": swapped_observations}, "the policy answers otherwise in 5 of 5 replayed episodes"),
        ({"spoil": swapped_actions}, "the policy answers otherwise in 5 of 5 replayed episodes"),
        ({"spoil": lost_state}, "the policy answers otherwise in 5 of 5 replayed episodes"),
        ({"change": half_rate}, "the contract differs from the reference's in control_period_s (0.04, the other 0.02)"),
    ],
    ids=["normalizer", "observations", "actions", "state", "rate"],
)
def test_a_fault_of_the_export_is_different(tmp_path, fault, reason):
    found = recurrent(tmp_path, **fault)
    assert found.verdict == "DIFFERENT" and any(reason in row for row in found.reasons), str(found)


def test_a_policy_with_plans_is_compared_by_its_logits(tmp_path):
    _, opened, model = exported("lads", tmp_path)
    ids = [row.id for row in opened.contract.instructions[:2]]
    verify = lambda reference: lads.verify(
        reference,
        opened.controller(),
        environments.Servo,
        instructions=ids,
        episodes=6,
        traced=3,
        sub_tasks=("high", "low"),
        completed="tasks",
        success="is_success",
    )
    found = verify(InOnnxRuntime(model))
    assert found.verdict == "INCONCLUSIVE", str(found)
    policy = found.data["policy"]
    assert policy["decisions"] == policy["compared_decisions"] == 2 * 3 * 10 and policy["differing_episodes"] == 0
    assert {row["name"] for row in found.data["rollouts"]["rates"]} == {"high", "low", "full success"}
    # What gives actions alone is compared by them.
    whole = InOnnxRuntime(model)

    class ByActions:
        reset = whole.reset

        def __call__(self, observation):
            return whole(observation).action

    found = verify(ByActions())
    assert found.data["policy"]["decisions"] == 0 and found.data["policy"]["differing_episodes"] == 0
    assert any("indices and their scores" in row for row in found.data["not_covered"])


class Seen(environments.Servo):
    """The servo as a camera shows it, with its first elements beside the frame."""

    def reset(self, **more):
        _, info = super().reset(**more)
        return self.seen(), info

    def step(self, action):
        _, *rest = super().step(action)
        return self.seen(), *rest

    def seen(self):
        grid = np.sin(np.outer(np.arange(16 * 20 * 3), self.state[:3] + 1)).sum(1)
        return {"observation": self.state[:4].astype(np.float32), "camera": np.uint8(128 + 40 * grid).reshape(16, 20, 3)}


def test_a_policy_that_sees_and_observes_gets_both(tmp_path):
    def damage(policy):
        policy.low_level.embed_observation.weight[:, :4] *= 1.05

    _, opened, model = exported("sighted_history", tmp_path)
    known = [opened.contract.instructions[0].id]
    verify = lambda policy: lads.verify(InOnnxRuntime(model), policy.controller(), Seen, instructions=known, episodes=3, traced=2)
    found = verify(opened)
    assert found.verdict == "INCONCLUSIVE", str(found)  # few episodes
    policy = found.data["policy"]
    assert policy["compared_steps"] == 2 * 40 and policy["compared_decisions"] == 2 * 10 and policy["differing_episodes"] == 0
    found = verify(exported("sighted_history", tmp_path, spoil=damage)[1])
    assert found.verdict == "DIFFERENT" and found.data["policy"]["differing_episodes"] == 2


def test_fewer_bits_are_judged_beside_32(tmp_path):
    """Tests that decisions with fewer bits are judged by their margins, and that an image whose bundle is not at hand is not judged."""
    _, opened, model = exported("lads", tmp_path)
    path, image = tmp_path / "lads.onnx", tmp_path / "lads.lads"
    rounded = lads.open(path, weights="f16", force=True)
    ids = [row.id for row in opened.contract.instructions[:2]]
    verify = lambda policy: lads.verify(InOnnxRuntime(model), policy.controller(), environments.Servo, instructions=ids, episodes=2, traced=2)
    found = verify(rounded).data
    assert found["exact"]["differing_episodes"] == 0
    assert found["rounding"]["decisions"] == 2 * 2 * 10 and found["rounding"]["smallest_margin"] > 0
    assert found["rounding"]["largest_logit_difference"] > found["exact"]["largest_logit_difference"]
    subprocess.run([sys.executable, "-m", "lads", "compile", path, "--weights", "f16", "--force", "-o", image], check=True)
    with pytest.raises(lads.errors.ProofError, match="open the bundle"):
        verify(lads.open(image))


def test_too_few_episodes_are_inconclusive(tmp_path):
    policy, opened, _ = exported("recurrent", tmp_path)
    reference = InPyTorch(policy, (-1, np.array([0.9, 0.8, 0.7], np.float32)))
    found = lads.verify(reference, opened.controller(), environments.Servo, episodes=5)
    assert found.verdict == "INCONCLUSIVE" and found.data["more_episodes_per_instruction"] > 30


def test_an_environment_that_is_not_the_same_twice(tmp_path):
    policy, opened, _ = exported("recurrent", tmp_path)
    reference = InPyTorch(policy, (-1, np.array([0.9, 0.8, 0.7], np.float32)))

    class Unseeded(environments.Servo):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=None, options=options)

    found = lads.verify(reference, opened.controller(), Unseeded, episodes=3)
    assert found.verdict == "DIFFERENT" and any("the environment moves otherwise" in row for row in found.reasons)


def test_certificates_are_written(tmp_path):
    found = recurrent(tmp_path)
    assert found.verdict == "INCONCLUSIVE"
    found.write(tmp_path / "certificate.json")
    found.write(tmp_path / "certificate.html")
    schema = json.loads((PROJECT / "sim-harness/proof/certificate.schema.json").read_text())
    jsonschema.validate(json.loads((tmp_path / "certificate.json").read_text()), schema)
    page = (tmp_path / "certificate.html").read_text()
    assert "INCONCLUSIVE" in page and "weights from PyTorch" in page and str(found).startswith("INCONCLUSIVE\n- ")
    with pytest.raises(lads.errors.ProofError, match="nowhere/a.html: it cannot be written"):
        found.write(tmp_path / "nowhere/a.html")


@pytest.mark.parametrize(("more", "text"), [(-10, "the environment ended after 31 states, the reference's after 41"), (10, "the environment continues after 41 states, the reference's ended")])
def test_an_environment_that_ends_otherwise(tmp_path, more, text):
    policy, opened, _ = exported("recurrent", tmp_path)

    class Third(environments.Servo):
        """Every third episode, which is the reference's actions executed again, has another length."""

        episodes = 0

        def reset(self, **arguments):
            self.episodes += 1
            self.STEPS = 40 + more * (self.episodes % 3 == 0)
            return super().reset(**arguments)

    found = lads.verify(InPyTorch(policy, (-1, 1)), opened.controller(), Third, episodes=2)
    assert found.verdict == "DIFFERENT" and found.data["environment"]["first_difference"]["what"] == text, str(found)


def test_without_a_control_period_the_contract_is_not_compared(plain):
    class Untimed(environments.Servo):
        dt = None

    same = plain.controller()
    verify = lambda **arguments: lads.verify(lambda seen: same.step(seen)[0], plain.controller(), Untimed, episodes=60, traced=1, success=lambda rollout: True, **arguments)
    found = verify()
    assert found.verdict == "INCONCLUSIVE" and found.data["contract"]["fields"] == []
    assert any("the contract was not compared" in row and "give control_period=" in row and "--complete" not in row for row in found.reasons), str(found)
    found = verify(control_period=plain.contract.control_period)
    assert found.verdict == "EQUIVALENT" and any("the contract beyond its control period" in row for row in found.data["not_covered"])


def test_a_plan_without_scores_is_refused(tmp_path):
    _, opened, model = exported("lads", tmp_path)
    whole = InOnnxRuntime(model)

    class WithoutScores:
        reset = whole.reset

        def __call__(self, observation):
            reply = whole(observation)
            return lads.Reply(reply.action, reply.plan)

    known = [opened.contract.instructions[0].id]
    with pytest.raises(lads.errors.ProofError, match="a plan before it has given scores"):
        lads.verify(WithoutScores(), opened.controller(), environments.Servo, instructions=known, episodes=1, success="is_success")


def narrow():
    """Makes an environment whose action space is smaller than the contract's limits."""
    environment = environments.Servo()
    environment.action_space = gymnasium.spaces.Box(np.float32([-5, -0.5, -5]), np.float32([5, 0.5, 5]))
    return environment


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"reference": lambda seen: np.zeros(4)}, lads.errors.ProofError, r"the reference gives an action of shape \(4,\), the contract says \(3,\)"),
        ({"episodes": 0}, lads.errors.ProofError, "episodes is 0; give 1 or more"),
        ({"make_env": lambda: gymnasium.make("Pendulum-v1"), "observation": environments.fill, "action": lambda action: action[:1]}, lads.errors.EvaluationError, "says nothing about success; give success="),
        ({"success": "won"}, lads.errors.EvaluationError, "no 'won'; give success="),
        ({"max_steps": 0}, lads.errors.EvaluationError, "max_steps is 0"),
        ({"make_env": narrow}, lads.errors.ProofError, "the contract's limits of joint2_velocity exceed the environment's action space; give action="),
        ({"make_env": lambda: environments.Servo(observe=5), "observation": lambda seen: seen[:5]}, lads.errors.InputError, r"channel 'observation': the environment gives shape \(5,\), the policy takes \(8,\); give observation="),
    ],
)
def test_what_cannot_be_compared_is_named(plain, arguments, error, text):
    given = {"reference": lambda seen: np.zeros(3, np.float32), "make_env": environments.Servo, "episodes": 2, **arguments}
    with pytest.raises(error, match=text):
        lads.verify(given.pop("reference"), plain.controller(), given.pop("make_env"), **given)
