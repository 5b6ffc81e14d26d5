"""Tests the installed wheel with nothing but numpy: run as a program with a policy's path."""

import importlib.metadata
import sys

import numpy as np

import lads

installed = {row.metadata["Name"].lower() for row in importlib.metadata.distributions()} - {"pip", "setuptools"}
assert installed == {"lads", "numpy"}, installed
assert "site-packages" in lads.__file__, lads.__file__

policy = lads.open(sys.argv[1])
test = policy.self_test()
golden = policy.golden
controller = policy.controller(golden.instruction)
actions = [controller.step(row)[0] for row in golden.observations["observation"]]
assert np.abs(np.stack(actions) - golden.actions).max() <= golden.tolerance
actions, report = lads.vector.Controllers(policy, 2, golden.instruction).step(golden.observations["observation"][:2].copy())
assert actions.shape == (2, 9) and report.timestep.tolist() == [0, 0]


class Bench:
    """Three steps of an environment without gymnasium."""

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return golden.observations["observation"][0], {}

    def step(self, action):
        self.time += 1
        return golden.observations["observation"][self.time], 1.0, self.time == 3, False, {"success": True}


found = lads.gym.evaluate(controller, Bench, 4, processes=1, progress=False)
assert found.success.rate == 1.0 and found.mean_reward == 3.0
print(f"lads {lads.__version__}: {test.steps} steps replayed, digest {test.digest}")
