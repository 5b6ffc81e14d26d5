"""rsl_rl to a certificate: a policy of Pendulum-v1 is trained, exported by rsl_rl itself, imported, and compared with what was trained.

    python runtime/python/examples/rsl_rl_pendulum.py

rsl_rl puts the normaliser into the graph and leaves clips and limits to the environment. Needs rsl-rl-lib and gymnasium.
"""

import sys
import tempfile
from pathlib import Path

import gymnasium
import lads
import numpy as np
import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

ROBOT = """
environment = { id = "Pendulum-v1", version = "1" }
control_period_s = 0.05

[[term]]
name = "pendulum"
elements = ["cos", "sin", "velocity"]
unit = "1"
min = [-1.01, -1.01, -8.01]
max = [1.01, 1.01, 8.01]

[action]
elements = ["torque"]
unit = "N*m"
scale = 1
offset = 0
min = -2
max = 2
"""


class Pendulums(VecEnv):
    """Many copies of Pendulum-v1, in the form of rsl_rl's environments."""

    def __init__(self, count):
        self.environments = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1")] * count)
        self.num_envs, self.num_actions, self.max_episode_length = count, 1, 200
        self.device, self.cfg = "cpu", {}
        self.episode_length_buf = torch.zeros(count, dtype=torch.long)
        self.observation, _ = self.environments.reset(seed=0)

    def get_observations(self):
        return TensorDict({"policy": torch.from_numpy(self.observation)}, batch_size=[self.num_envs])

    def step(self, actions):
        self.observation, rewards, terminated, truncated, _ = self.environments.step(actions.numpy())
        over = torch.from_numpy(terminated | truncated)
        self.episode_length_buf = torch.where(over, 0, self.episode_length_buf + 1)
        extras = {"time_outs": torch.from_numpy(truncated)}
        return self.get_observations(), torch.from_numpy(rewards.astype(np.float32)), over, extras


def train(iterations):
    """Trains a policy -> rsl_rl's runner."""
    torch.manual_seed(0)
    network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": True}
    settings = {
        "algorithm": {"class_name": "PPO", "rnd_cfg": None, "symmetry_cfg": None},
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
        "critic": network,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": 24,
        "save_interval": 1000,
    }
    runner = OnPolicyRunner(Pendulums(16), settings)
    runner.learn(iterations)
    return runner


def main(folder, iterations=100, episodes=60):
    """Writes everything into the folder and verifies the import -> the certificate."""
    folder = Path(folder)
    runner = train(iterations)
    runner.export_policy_to_onnx(str(folder))
    (folder / "robot.toml").write_text(ROBOT)
    policy = lads.import_onnx(folder / "policy.onnx", folder / "robot.toml", output=folder / "policy.lads.onnx")
    network = runner.get_inference_policy()

    def trained(observation):
        with torch.inference_mode():
            return network(TensorDict({"policy": torch.from_numpy(observation[None])}, batch_size=[1]))[0].numpy()

    make = lambda: gymnasium.make("Pendulum-v1")
    upright = lambda rollout: rollout.total_reward > -300
    certificate = lads.verify(trained, policy.controller(), make, episodes=episodes, success=upright, reference_name="rsl_rl")
    certificate.write(folder / "certificate.html")
    return certificate


if __name__ == "__main__":
    print(main(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()))
