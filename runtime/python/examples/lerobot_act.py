"""LeRobot to a certificate: a policy of ACT's form, its normaliser from the files beside it, exported, imported, and compared.

    python runtime/python/examples/lerobot_act.py

LeRobot keeps the statistics of its normaliser in files of their own, read by pre- and postprocessor; a key that does not match leaves the
policy without one and says nothing. Here a missing one is an error, and the statistics go into the graph. LeRobot pins other versions of
torch, so the policy is a small one of ACT's form: a transformer that answers an observation with a chunk of actions, of which the first is
executed (`n_action_steps` of 1). With LeRobot installed, `ACTPolicy.from_pretrained(folder).model` takes its place. Needs torch, onnx, safetensors.
"""

import json
import sys
import tempfile
from pathlib import Path

import lads
import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import nn

STATE, TARGET, ACTION = "observation.state", "observation.environment_state", "action"
CHUNK, DIM = 8, 32

ROBOT = """
environment = { id = "reach", version = "1" }
control_period_s = 0.1

[[term]]
name = "state"
elements = ["x", "y"]
unit = "m"
min = -2
max = 2

[[term]]
name = "target"
elements = ["x", "y"]
unit = "m"
min = -2
max = 2

[action]
elements = ["x", "y"]
unit = "m"
scale = 1
offset = 0
min = -2
max = 2
"""


class Act(nn.Module):
    """The form of LeRobot's ACT at inference: tokens of latent, state and environment, an encoder, a decoder of one query per action."""

    def __init__(self):
        super().__init__()
        self.state, self.target = nn.Linear(2, DIM), nn.Linear(2, DIM)
        self.latent = nn.Parameter(torch.randn(1, 1, DIM))
        self.position, self.queries = nn.Parameter(torch.randn(1, 3, DIM)), nn.Parameter(torch.randn(1, CHUNK, DIM))
        self.encoder, self.decoder = Layer(), Layer()
        self.head = nn.Linear(DIM, 2)

    def forward(self, batch):
        tokens = torch.cat([self.latent, self.state(batch[STATE])[:, None], self.target(batch[TARGET])[:, None]], 1) + self.position
        memory = self.encoder(tokens, tokens)
        return self.head(self.decoder(self.queries, memory)), (None, None)


class Layer(nn.Module):
    """Attention and a feed-forward network, each with its residual and norm."""

    def __init__(self):
        super().__init__()
        self.query, self.key, self.value, self.out = (nn.Linear(DIM, DIM) for _ in range(4))
        self.wide, self.narrow = nn.Linear(DIM, 2 * DIM), nn.Linear(2 * DIM, DIM)
        self.first, self.second = nn.LayerNorm(DIM), nn.LayerNorm(DIM)

    def forward(self, x, memory):
        weights = torch.softmax(self.query(x) @ self.key(memory).transpose(1, 2) / DIM**0.5, -1)
        x = self.first(x + self.out(weights @ self.value(memory)))
        return self.second(x + self.narrow(torch.relu(self.wide(x))))


def pretrained(folder):
    """Writes the files that LeRobot's `save_pretrained` leaves, as far as they matter here -> the network."""
    torch.manual_seed(0)
    network = Act().eval()
    save_file({f"model.{name}": value for name, value in network.state_dict().items()}, folder / "model.safetensors")
    features = {STATE: ("STATE", "MEAN_STD"), TARGET: ("ENV", "MEAN_STD"), ACTION: ("ACTION", "MEAN_STD")}
    config = {"type": "act", "n_action_steps": 1, "chunk_size": CHUNK, "normalization_mapping": {kind: mode for kind, mode in features.values()}}
    (folder / "config.json").write_text(json.dumps(config))
    statistics = {}
    for name, (mean, std) in {STATE: (0.1, 0.6), TARGET: (-0.2, 0.5), ACTION: (0.3, 0.7)}.items():
        statistics |= {f"{name}.mean": torch.full((2,), mean), f"{name}.std": torch.tensor([std, 1.5 * std])}
    for kind, step in (("preprocessor", "step_3_normalizer"), ("postprocessor", "step_0_unnormalizer")):
        save_file(statistics, folder / f"policy_{kind}_{step}_processor.safetensors")
    return network


class Deployed(nn.Module):
    """Preprocessor, network and postprocessor in one graph: the first action of the chunk, in the robot's units."""

    def __init__(self, network, statistics):
        super().__init__()
        self.network = network
        wanted = [f"{name}.{kind}" for name in (STATE, TARGET, ACTION) for kind in ("mean", "std")]
        missing = [key for key in wanted if key not in statistics]
        if missing:
            raise KeyError(f"the statistics lack {', '.join(missing)}; the policy would run without its normaliser")
        for key in wanted:
            self.register_buffer(key.replace(".", "_"), statistics[key])

    def statistic(self, name):
        name = name.replace(".", "_")
        return getattr(self, f"{name}_mean"), getattr(self, f"{name}_std")

    def forward(self, observation):
        batch = {}
        for name, values in ((STATE, observation[:, :2]), (TARGET, observation[:, 2:])):
            mean, std = self.statistic(name)
            batch[name] = (values - mean) / (std + 1e-8)
        mean, std = self.statistic(ACTION)
        return self.network(batch)[0][:, 0] * std + mean


class Reach:
    """A point that moves to its commanded position at 10 Hz, and a target, with the API of Gymnasium."""

    dt = 0.1

    def reset(self, *, seed=None, options=None):
        self.random = np.random.default_rng(seed)
        self.point, self.target = self.random.uniform(-1, 1, (2, 2))
        self.time = 0
        return np.concatenate([self.point, self.target]), {}

    def step(self, action):
        self.point = np.clip(self.point + 0.3 * (action - self.point) + self.random.normal(0, 0.01, 2), -2, 2)
        self.time += 1
        distance = float(np.linalg.norm(self.point - self.target))
        return np.concatenate([self.point, self.target]), -distance, False, self.time == 50, {"success": distance < 1.0}


def export(folder):
    """Exports policy.onnx from the folder's files -> the network with its processors."""
    network = Act()
    weights = load_file(folder / "model.safetensors")
    network.load_state_dict({name.removeprefix("model."): value for name, value in weights.items()})
    deployed = Deployed(network, load_file(folder / "policy_preprocessor_step_3_normalizer_processor.safetensors")).eval()
    torch.onnx.export(deployed, torch.zeros(1, 4), folder / "policy.onnx", input_names=["observation"], output_names=["action"], opset_version=18, dynamo=False)
    return deployed


def main(folder, episodes=60):
    """Writes everything into the folder and verifies the import -> the certificate."""
    folder = Path(folder)
    network = pretrained(folder)
    export(folder)
    (folder / "robot.toml").write_text(ROBOT)
    imported = lads.import_onnx(folder / "policy.onnx", folder / "robot.toml", output=folder / "policy.lads.onnx")
    statistics = load_file(folder / "policy_postprocessor_step_0_unnormalizer_processor.safetensors")
    scaled = lambda name, values: (values - statistics[f"{name}.mean"]) / (statistics[f"{name}.std"] + 1e-8)

    def trained(observation):
        """Runs LeRobot's loop: preprocessor, policy, postprocessor."""
        seen = torch.from_numpy(observation[None])
        with torch.inference_mode():
            chunk, _ = network({STATE: scaled(STATE, seen[:, :2]), TARGET: scaled(TARGET, seen[:, 2:])})
        action = chunk[0, 0] * statistics[f"{ACTION}.std"] + statistics[f"{ACTION}.mean"]
        return action.clip(-2, 2).numpy()

    certificate = lads.verify(trained, imported.controller(), Reach, episodes=episodes, reference_name="LeRobot loop")
    certificate.write(folder / "certificate.html")
    return certificate


if __name__ == "__main__":
    print(main(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()))
