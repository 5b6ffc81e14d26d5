"""A tiny synthetic dataset: each instruction is a sequence of drives towards fixed targets, so plans are learnable."""

import json

import numpy as np
from safetensors.numpy import save_file

TARGETS = {"drawer": (0.8, -0.5, 0.4), "lamp": (-0.8, 0.5, -0.4), "lever": (0.5, 0.8, 0.1)}


def episode(sub_tasks, rng):
    state = rng.uniform(-0.1, 0.1, 5)
    states, actions = [], []
    for task in sub_tasks:
        target = np.array(TARGETS[task])
        for _ in range(int(rng.integers(7, 10))):
            action = np.clip(2 * (target - state[:3]), [-1, -1, -0.5], [1, 1, 0.5])
            states.append(state.copy())
            actions.append(action)
            state[:3] += 0.3 * action
            state[3:] = rng.uniform(-0.2, 0.2, 2)
    return np.array(states, np.float32), np.array(actions, np.float32)


def write(path, setting, episodes=24, seed=0, **metadata):
    """Writes a dataset for the tiny setting; `metadata` overrides keys (None removes one)."""
    rng = np.random.default_rng(seed)
    seen = [row for row in setting.instructions if row["split"] == "seen"]
    labels = np.arange(episodes) % len(seen)
    parts = [episode(seen[label]["sub_tasks"], rng) for label in labels]
    states = np.concatenate([part[0] for part in parts])
    actions = np.concatenate([part[1] for part in parts])
    tensors = {
        "observations": (states + rng.uniform(-0.01, 0.01, states.shape)).astype(np.float32),
        "states": states,
        "actions": actions,
        "executed": np.clip(actions, -1, 1),
        "episode_offsets": np.cumsum([0, *(len(part[0]) for part in parts)]).astype(np.int64),
        "instruction": labels.astype(np.int64),
    }
    known = [{key: row[key] for key in ("id", "text", "sub_tasks")} for row in seen]
    fields = {
        "format": "lads-dataset",
        "version": "1",
        "environment": setting.environment["id"],
        "instructions": json.dumps(known),
        **metadata,
    }
    save_file(tensors, path, metadata={key: value for key, value in fields.items() if value is not None})
    return path
