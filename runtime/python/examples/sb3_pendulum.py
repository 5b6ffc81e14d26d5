"""Stable-Baselines3 to a certificate: a policy of Pendulum-v1 is trained, exported, imported, and compared with what was trained.

    python runtime/python/examples/sb3_pendulum.py

Stable-Baselines3 keeps the normaliser of observations in VecNormalize, outside of the policy and of its export. Whoever forgets it deploys
another policy; here it is written into the robot's description. Needs stable-baselines3, onnx and gymnasium.
"""

import sys
import tempfile
from pathlib import Path

import gymnasium
import lads
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


def train(steps):
    """Trains a policy -> the policy, and the environment with its normaliser."""
    environment = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), norm_reward=False)
    model = PPO("MlpPolicy", environment, n_steps=256, seed=0, device="cpu")
    return model.learn(steps), environment


class Deterministic(torch.nn.Module):
    """The policy without exploration, as the documentation of Stable-Baselines3 exports it: actions, values, log-probabilities."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, observation):
        return self.policy(observation, deterministic=True)


def export(model, path):
    """Writes the policy as ONNX."""
    observation = torch.zeros(1, *model.observation_space.shape)
    names = ["actions", "values", "log_prob"]
    torch.onnx.export(Deterministic(model.policy), observation, path, input_names=["observation"], output_names=names, opset_version=17, dynamo=False)


def described(environment):
    """Describes what the export lacks: units, limits, and the normaliser, which is clip((raw - mean) / std)."""
    statistics = environment.obs_rms
    scale = 1 / np.sqrt(statistics.var + environment.epsilon)
    return f"""
environment = {{ id = "Pendulum-v1", version = "1" }}
control_period_s = 0.05
input.observation.clip = {environment.clip_obs}

[[term]]
name = "pendulum"
elements = ["cos", "sin", "velocity"]
unit = "1"
min = [-1.01, -1.01, -8.01]
max = [1.01, 1.01, 8.01]
offset = {statistics.mean.tolist()}
scale = {scale.tolist()}

[action]
output = "actions"
elements = ["torque"]
unit = "N*m"
scale = 1
offset = 0
min = -2
max = 2
"""


def verified(model, environment, policy, episodes):
    """Verifies that the import is the policy that was trained -> lads.Certificate."""

    def trained(observation):
        return model.predict(environment.normalize_obs(observation), deterministic=True)[0]

    make = lambda: gymnasium.make("Pendulum-v1")
    upright = lambda rollout: rollout.total_reward > -300
    return lads.verify(trained, policy.controller(), make, episodes=episodes, success=upright, reference_name="Stable-Baselines3")


def main(folder, steps=20_000, episodes=60):
    """Writes everything into the folder and verifies the import -> the certificate."""
    folder = Path(folder)
    model, environment = train(steps)
    export(model, folder / "policy.onnx")
    (folder / "robot.toml").write_text(described(environment))
    policy = lads.import_onnx(folder / "policy.onnx", folder / "robot.toml", output=folder / "policy.lads.onnx")
    certificate = verified(model, environment, policy, episodes)
    certificate.write(folder / "certificate.html")
    return certificate


if __name__ == "__main__":
    print(main(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()))
