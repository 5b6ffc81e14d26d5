"""Environments of the tests, importable by other processes."""

import os
from pathlib import Path

import gymnasium
import numpy as np


def inside(state):
    """Clips an observation to the limits of the random policies."""
    return np.clip(state, -0.09, 0.5)


class Servo(gymnasium.Env):
    """Three joints that follow the action at 50 Hz and five disturbances, observed as the random policies of the tests take it."""

    metadata = {}
    dt = 0.02
    STEPS = 40

    def __init__(self, observe=8):
        self.observation_space = gymnasium.spaces.Box(-10, 10, (observe,), np.float64)
        self.action_space = gymnasium.spaces.Box(-5.0, 5.0, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = inside(self.np_random.uniform(-0.3, 0.3, 8))
        self.state[0] += (options or {}).get("shift", 0.0)
        self.time = 0
        return self.state.copy(), {}

    def step(self, action):
        action = np.clip(np.asarray(action, np.float64), -1, 1)
        self.state[:3] += 0.1 * (action - self.state[:3])
        self.state[3:] = 0.9 * self.state[3:] + 0.05 * np.sin(self.time + self.state[0]) + 0.01 * self.np_random.normal(size=5)
        self.state = inside(self.state)
        self.time += 1
        done = self.time == self.STEPS
        info = {"is_success": bool(self.state[:3].sum() > 0), "tasks": ["low"] * bool(self.state[0] < 0) + ["high"] * bool(self.state[1] > 0.1)}
        return self.state.copy(), float(-np.square(self.state).sum()), False, done, info


class Closing(Servo):
    """Environment that writes a file, named by its process, when it is closed."""

    def __init__(self, folder):
        super().__init__()
        self.folder = folder

    def close(self):
        (Path(self.folder) / f"closed-{os.getpid()}").touch()


class Kitchen:
    """The official FrankaKitchen-v1 with the noise of the shipped results, as an environment of the API."""

    def __init__(self, instruction, commanded, noise="v0"):
        from lads_exporter.official import OfficialKitchen

        self.official = OfficialKitchen(noise)
        self.instruction, self.commanded = instruction, commanded
        self.action_space = self.official.official.action_space

    def reset(self, *, seed=None, options=None):
        return self.official.reset([0, self.instruction, options["episode"]], self.commanded), {}

    def step(self, action):
        observation = self.official.step(action)
        done = self.official.succeeded(self.commanded)
        info = {"episode_task_completions": list(self.official.completions), "is_success": done}
        return observation, float(done), done, self.official.steps == self.official.MAX_STEPS, info

    def close(self):
        self.official.close()


def kitchen():
    """The first instruction of the kitchen policies."""
    return Kitchen(0, ["kettle", "bottom burner", "light switch", "slide cabinet"])


def numbered(episode):
    """Returns options that contain the episode's number."""
    return {"episode": episode}


def first_high(action):
    """A discrete action of two."""
    return int(action[0] > 0.1)


def fill(observation):
    """Small observations of a classic environment as the eight that the random policy takes, inside its limits."""
    return inside(np.resize(observation, 8))
