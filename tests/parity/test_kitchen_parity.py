"""Tests the harness's kitchen against the official FrankaKitchen-v1 of gymnasium-robotics.

Run with `python -m pytest tests/parity`. Needs lads_exporter, numpy, mujoco 3.17.0, gymnasium and gymnasium-robotics 1.4.2, and the harness's
`kitchen-trace` (`cargo build -p lads-sim`); skipped where they are missing. KITCHEN_TRACE names another binary.
"""

import json
import os
import pathlib
import subprocess

import pytest

np = pytest.importorskip("numpy")
mujoco = pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")
gymnasium_robotics = pytest.importorskip("gymnasium_robotics")

from gymnasium_robotics.envs.franka_kitchen import kitchen_env  # noqa: E402
from gymnasium_robotics.utils import mujoco_utils  # noqa: E402

pytest.importorskip("lads_exporter.official")
from lads_exporter.official import AMPLITUDES, SUB_TASKS, Noise, joint_qpos, joint_qvel, positions  # noqa: E402
from programs import newest  # noqa: E402

TOLERANCE = 1e-9
STEPS = 1000


def trace_binary():
    """Finds the harness's `kitchen-trace`: the newest build, or the one that KITCHEN_TRACE names."""
    if "KITCHEN_TRACE" in os.environ:
        return pathlib.Path(os.environ["KITCHEN_TRACE"])
    return newest("kitchen-trace")


class Harness:
    """The Rust environment behind a pipe."""

    def __enter__(self):
        self.process = subprocess.Popen([trace_binary()], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        assert self.process.wait(timeout=30) == 0
        self.process.stdout.close()

    def ask(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def reset(self, noise, entropy):
        return self.ask(f"reset {noise} {' '.join(map(str, entropy))}")

    def step(self, action):
        return self.ask(json.dumps([float(x) for x in action]))


@pytest.fixture
def official(monkeypatch):
    """Makes FrankaKitchen-v1 by `official(robot_noise_ratio, object_noise_ratio)`."""
    monkeypatch.setattr(mujoco_utils, "get_joint_qpos", joint_qpos)
    monkeypatch.setattr(mujoco_utils, "get_joint_qvel", joint_qvel)
    made = []

    def make(robot, objects):
        environment = kitchen_env.KitchenEnv(
            tasks_to_complete=SUB_TASKS,
            terminate_on_tasks_completed=False,
            robot_noise_ratio=robot,
            object_noise_ratio=objects,
        )
        made.append(environment)
        return environment

    yield make
    for environment in made:
        environment.close()


def random_actions(seed, steps):
    """Draws random actions that keep their direction for a while, so that the arm travels and touches things."""
    rng = np.random.default_rng(seed)
    action = np.zeros(9)
    for _ in range(steps):
        action = 0.9 * action + 0.6 * rng.normal(size=9)
        yield action


def same_run(environment, harness, observation, answer, actions):
    """Steps both environments; returns the largest difference of the observations and the official completions."""
    worst = np.abs(positions(observation) - answer["observation"]).max()
    completions = []
    for step, action in enumerate(actions, 1):
        observation, _, _, _, info = environment.step(action)
        answer = harness.step(action)
        completions += [[task, step] for task in info["step_task_completions"] if task not in [c[0] for c in completions]]
        worst = max(worst, np.abs(positions(observation) - answer["observation"]).max())
    assert sorted(completions) == sorted(answer["completions"])
    return worst, completions


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_actions_without_noise(official, seed):
    environment = official(0.0, 0.0)
    with Harness() as harness:
        observation, _ = environment.reset(seed=seed)
        answer = harness.reset("none", [0, 0, 0])
        worst, _ = same_run(environment, harness, observation, answer, random_actions(seed, STEPS))
    assert worst <= TOLERANCE


@pytest.mark.parametrize(("noise", "robot", "objects"), [("v0", 0.1, 0.1), ("v1", 0.01, 0.0005)])
def test_the_closed_loop_with_our_noise_in_both(official, noise, robot, objects):
    """Tests that observation noise moves the set-points alike: equal trajectories mean equal noise and equal use of it."""
    entropy = [5, 3, 1]
    environment = official(robot, objects)
    robot_env = environment.robot_env
    # FrankaKitchen-v1 takes the objects' amplitudes from one place too early; D4RL, whose noise v0 is, does not.
    object_scale = AMPLITUDES[9:] / robot_env.robot_pos_noise_amp[8:] if noise == "v0" else np.ones(21)
    with Harness() as harness:
        environment.reset(seed=0)
        robot_env._np_random = Noise(entropy, object_scale)
        observation = environment._get_obs(robot_env.reset_model())
        answer = harness.reset(noise, entropy)
        worst, _ = same_run(environment, harness, observation, answer, random_actions(7, 500))
    assert worst <= TOLERANCE


def test_completions_and_their_steps(official):
    """Replays an expert's actions, so that sub-tasks really are completed."""
    environment = official(0.0, 0.0)
    with Harness() as harness:
        demonstration = harness.ask("demonstrate microwave,kettle,bottom burner,light switch")["actions"]
        observation, _ = environment.reset(seed=0)
        answer = harness.reset("none", [0, 0, 0])
        worst, completions = same_run(environment, harness, observation, answer, demonstration)
    assert worst <= TOLERANCE
    assert [task for task, _ in completions] == ["microwave", "kettle", "bottom burner", "light switch"]


def test_our_stream_is_numpys():
    """Tests that v0 noise on a still scene is amplitude times the stream, number by number."""
    for entropy in ([0, 0, 0], [7, 3, 12], [2**40 + 5, 21, 2**32 + 9]):
        with Harness() as harness:
            answer = harness.reset("v0", entropy)
        expected = np.array(answer["state"]) + 0.1 * AMPLITUDES * np.random.default_rng(entropy).uniform(-1, 1, 30)
        assert np.array_equal(expected, answer["observation"])
