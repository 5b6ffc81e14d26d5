"""Isaac Lab to a certificate: an export in the form of isaaclab_rl, with the deploy.yaml of unitree_rl_lab beside it.

    python runtime/python/examples/isaac_lab.py

Between the sensors and the graph stand default posture, scales, the last action and the order of joints: what Isaac Lab's managers do in
training is done by the imported policy in the machine. Isaac Lab needs Isaac Sim, so policy, deploy.yaml and robot are small ones of the same
form: a leg of three joints that is to follow a command. Needs torch and onnx.
"""

import sys
import tempfile
from pathlib import Path

import lads
import numpy as np
import torch

# The policy's joints are hip, thigh and calf; the motors are wired as thigh, calf and hip. MOTOR[i] moves the policy's joint i.
MOTOR = [2, 0, 1]
DEFAULT = np.array([0.1, 0.8, -1.5], np.float32)
SCALE, VELOCITY_SCALE = 0.25, 0.05

# As unitree_rl_lab writes it into params/ beside the exported policy. Gains are in the order of the motors, the rest in the policy's.
DEPLOY = """
joint_ids_map: [2, 0, 1]
step_dt: 0.02
stiffness: [25.0, 30.0, 20.0]
damping: [0.5, 0.6, 0.4]
default_joint_pos: [0.1, 0.8, -1.5]
commands:
  base_velocity:
    ranges: {lin_vel_x: [-1.0, 1.0], lin_vel_y: null, ang_vel_z: [-0.5, 0.5], heading: null}
actions:
  JointPositionAction:
    clip: null
    scale: [0.25, 0.25, 0.25]
    offset: [0.1, 0.8, -1.5]
observations:
  velocity_commands: {params: {command_name: base_velocity}, clip: null, scale: [1.0, 1.0], history_length: 1}
  joint_pos_rel: {params: {}, clip: null, scale: [1.0, 1.0, 1.0], history_length: 1}
  joint_vel_rel: {params: {}, clip: null, scale: [0.05, 0.05, 0.05], history_length: 1}
  last_action: {params: {}, clip: null, scale: [1.0, 1.0, 1.0], history_length: 1}
"""

# What no file says.
ROBOT = """
environment = { id = "leg", version = "1" }
robot_joints = ["thigh", "calf", "hip"]

[[term]]
name = "velocity_commands"
unit = "m/s"

[[term]]
name = "joint_pos_rel"
min = -3.5
max = 3.5

[[term]]
name = "joint_vel_rel"
min = -40
max = 40

[[term]]
name = "last_action"

[action]
min = -3
max = 3
"""


class Exported(torch.nn.Module):
    """The export of an rsl_rl policy by isaaclab_rl: the normaliser of observations and the actor."""

    def __init__(self, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.register_buffer("mean", 0.1 * torch.randn(1, 11))
        self.register_buffer("std", 0.5 + torch.rand(1, 11))
        self.actor = torch.nn.Sequential(torch.nn.Linear(11, 64), torch.nn.ELU(), torch.nn.Linear(64, 32), torch.nn.ELU(), torch.nn.Linear(32, 3))

    def forward(self, x):
        return self.actor((x - self.mean) / (self.std + 1e-2))


def export(policy, folder):
    """Writes policy.onnx and params/deploy.yaml."""
    torch.onnx.export(policy, torch.zeros(1, 11), folder / "policy.onnx", input_names=["obs"], output_names=["actions"], opset_version=18, dynamo=False)
    (folder / "params").mkdir(exist_ok=True)
    (folder / "params/deploy.yaml").write_text(DEPLOY)


class Leg:
    """Three motors behind position controllers at 50 Hz, with the API of Gymnasium: raw readings in, joint targets out."""

    dt = 0.02

    def reset(self, *, seed=None, options=None):
        self.random = np.random.default_rng(seed)
        self.rest = by_motor(DEFAULT)
        self.position = self.rest + self.random.uniform(-0.2, 0.2, 3)
        self.velocity = np.zeros(3)
        self.command = self.random.uniform((-1.0, -0.5), (1.0, 0.5))
        self.time = 0
        return self.observed(), {}

    def observed(self):
        return {"command": self.command, "observation": np.concatenate([self.position, self.velocity])}

    def step(self, action):
        acceleration = 60.0 * (action - self.position) - 8.0 * self.velocity + self.random.normal(0, 2, 3)
        self.velocity = np.clip(self.velocity + self.dt * acceleration, -30, 30)
        self.position = np.clip(self.position + self.dt * self.velocity, -3, 3)
        self.time += 1
        error = float(np.abs(self.position - self.rest).max())
        return self.observed(), -error, False, self.time == 100, {"success": error < 1.0}


def by_motor(values):
    """Returns the values of the policy's joints in the order of the motors."""
    wired = np.empty_like(values)
    wired[MOTOR] = values
    return wired


class Trained:
    """The policy as Isaac Lab's observation and action managers run it in training."""

    def __init__(self, policy):
        self.policy = policy.eval()

    def reset(self):
        self.last = np.zeros(3, np.float32)

    def __call__(self, seen):
        position, velocity = np.split(seen["observation"], 2)
        terms = [seen["command"], position[MOTOR] - DEFAULT, VELOCITY_SCALE * velocity[MOTOR], self.last]
        with torch.inference_mode():
            self.last = self.policy(torch.from_numpy(np.concatenate(terms, dtype=np.float32)[None]))[0].numpy()
        return by_motor(np.clip(DEFAULT + SCALE * self.last, -3, 3))


def main(folder, episodes=60):
    """Writes everything into the folder and verifies the import -> the certificate."""
    folder = Path(folder)
    policy = Exported()
    export(policy, folder)
    (folder / "robot.toml").write_text(ROBOT)
    imported = lads.import_onnx(folder / "policy.onnx", folder / "robot.toml", output=folder / "policy.lads.onnx")
    print("\n".join(imported.notes))
    certificate = lads.verify(Trained(policy), imported.controller(), Leg, episodes=episodes, reference_name="Isaac Lab managers")
    certificate.write(folder / "certificate.html")
    return certificate


if __name__ == "__main__":
    print(main(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()))
