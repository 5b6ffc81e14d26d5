"""Evaluation in environments of Gymnasium's API: classic ones, the official kitchen, and one of our own."""

import functools
import json

import gymnasium
import numpy as np
import pytest

import environments
import lads
from conftest import PROJECT
from lads import gym


def servo(plain, **arguments):
    return gym.evaluate(plain.controller(), **{"make_env": environments.Servo, "episodes": 6, "seed": 3, **arguments})


def test_episodes_have_seeds_of_their_own(plain):
    controller = plain.controller()
    found = gym.evaluate(controller, environments.Servo, episodes=6, seed=3)
    assert [row.number for row in found.episodes] == list(range(6))
    assert len({row.seed for row in found.episodes}) == 6 and len({row.total_reward for row in found.episodes}) == 6
    assert found == servo(plain) and found != servo(plain, seed=4)
    assert servo(plain, episodes=3).episodes == found.episodes[:3], "whatever others are run"
    assert all(row.steps == 40 and row.truncated and not row.terminated for row in found.episodes)
    assert found.mean_steps == 40 and "6 episodes: success" in str(found)
    with pytest.raises(lads.errors.StepError, match="no step has been taken"):
        controller.executed(np.zeros(3, np.float32))  # it stays as it is


def test_over_processes_it_is_the_same(plain, tmp_path):
    assert servo(plain, processes=2, make_env=functools.partial(environments.Closing, tmp_path)) == servo(plain)
    assert 1 <= len(list(tmp_path.glob("closed-*"))) <= 2, "the environment of every process is closed"


def test_a_loop_of_ones_own_is_the_same(plain):
    environment = environments.Servo()
    policy = gym.Policy(plain.controller(), space=environment.action_space)
    found = servo(plain)
    for row in found.episodes:
        observation, _ = environment.reset(seed=row.seed)
        policy.reset()
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = environment.step(policy(observation))
            total += reward
            over = terminated or truncated
        assert total == row.total_reward and policy.report.timestep == row.steps - 1


def test_rates_have_wilson_intervals(plain):
    rate = gym.Rate(81, 263)
    assert rate.rate == 81 / 263 and rate.interval == pytest.approx((0.2553, 0.3662), abs=5e-5)  # Newcombe 1998, table I
    found = servo(plain, episodes=10).success
    assert found.episodes == 10 and found.interval[0] <= found.rate <= found.interval[1]
    with pytest.raises(lads.errors.ProofError, match="3 successes out of 2 trials"):
        lads._lads.wilson(3, 2)


def test_success_is_what_one_says(plain):
    by_key = servo(plain, success="is_success")
    assert by_key == servo(plain)
    below = servo(plain, success=lambda rollout: rollout.total_reward < 0)
    assert below.success.rate == 1.0
    with pytest.raises(lads.errors.EvaluationError, match="has no 'won'; give success="):
        servo(plain, success="won")
    tasks = servo(plain, sub_tasks=("high", "low"), completed="tasks")
    for row in tasks.episodes:
        assert row.success == (len(row.completions) == 2) and {name for name, _ in row.completions} <= {"high", "low"}
    assert tasks.score["n_rate"] == pytest.approx(np.mean([len(row.completions) for row in tasks.episodes]))
    assert tasks.score["full_success"] == tasks.success.rate and "un_instructed" not in tasks.score
    with pytest.raises(lads.errors.EvaluationError, match="no 'episode_task_completions'; give completed="):
        servo(plain, sub_tasks=("high",))


def test_reset_options_and_the_end(plain):
    shifted = servo(plain, options={"shift": 0.2})
    assert shifted != servo(plain) and shifted == servo(plain, options=lambda episode: {"shift": 0.2})
    short = servo(plain, max_steps=7)
    assert all(row.steps == 7 and row.truncated for row in short.episodes)


def test_progress_is_told(plain):
    told = []
    servo(plain, episodes=3, progress=lambda *row: told.append(row))
    assert told == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"episodes": 0}, "episodes is 0; give 1 or more"),
        ({"max_steps": 0}, "max_steps is 0; give 1 or more"),
        ({"make_env": lambda: environments.Servo(observe=5), "observation": lambda seen: seen[:5]}, r"episode 0: channel 'observation': the environment gives shape \(5,\), the policy takes \(8,\); give observation="),
        ({"observation": lambda seen: {"camera": seen}}, "episode 0: the environment's observation has no 'observation', it has 'camera'"),
        ({"observation": lambda seen: seen * np.nan}, "episode 0: channel `observation`, element 0 `joint1` is not finite"),
        ({"make_env": lambda: gymnasium.make("CartPole-v1"), "observation": environments.fill}, "the environment takes Discrete.*give action="),
        ({"make_env": lambda: gymnasium.make("Pendulum-v1"), "observation": environments.fill}, r"takes actions of shape \(1,\), the policy gives 3"),
    ],
)
def test_what_does_not_fit_is_named(plain, arguments, text):
    with pytest.raises(lads.LadsError, match=text):
        gym.evaluate(plain.controller(), **{"make_env": environments.Servo, "episodes": 1, **arguments})


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("CartPole-v1", environments.first_high),
        ("Acrobot-v1", environments.first_high),
        ("MountainCar-v0", environments.first_high),
        ("MountainCarContinuous-v0", lambda action: action[:1]),
        ("Pendulum-v1", lambda action: 2 * action[:1]),
        ("InvertedPendulum-v5", lambda action: action[:1]),
        ("Reacher-v5", lambda action: action[:2]),
    ],
)
def test_environments_of_gymnasium(plain, name, action):
    found = gym.evaluate(plain.controller(), lambda: gymnasium.make(name), episodes=3, observation=environments.fill, action=action)
    assert len(found.episodes) == 3 and found.success is None
    again = gym.evaluate(plain.controller(), lambda: gymnasium.make(name), episodes=3, observation=environments.fill, action=action, processes=2)
    assert again == found
    judged = gym.evaluate(plain.controller(), lambda: gymnasium.make(name), 3, observation=environments.fill, action=action, success=lambda rollout: rollout.terminated)
    assert judged.success == gym.Rate(sum(row.terminated for row in found.episodes), 3)


def test_the_official_kitchen_as_lads_run_has_it():
    """The kitchen's completions equal those of the shipped results, which `lads-run` wrote, step by step."""
    policy = lads.open(PROJECT / "models/kitchen.onnx")
    shipped = json.loads((PROJECT / "models/kitchen.results.json").read_text())["instructions"][0]
    tasks = [row["sub_task"] for row in shipped["completions"]]
    found = gym.evaluate(policy.controller(shipped["id"]), environments.kitchen, episodes=3, options=environments.numbered, sub_tasks=tasks)
    for row, run in zip(found.episodes, shipped["runs"]):
        expected = [(done["sub_task"], done["step"]) for done in run["completions"] if done["commanded"]]
        assert list(row.completions) == expected and row.steps == run["steps"], row.number
    assert found.score["n_rate"] == 4.0 and found.success.rate == 1.0
