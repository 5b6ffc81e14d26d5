"""The single-file bundle: graphs, contract and golden episode in one ONNX file.

`save` replaces the target only when the whole file is written.
"""

import base64
import hashlib
import json

import numpy as np
import onnx
from onnx import helper
from safetensors.numpy import save as save_safetensors

from . import __version__, graphs
from .config import UserError
from .output import write_atomically
from .replay import Bundle

GOLDEN_TOLERANCE = 1e-4
GOLDEN_MARGIN = 1e-2  # smallest difference between the two best logits at any decision of a golden episode


def contract(setting, encoded, provenance):
    """The JSON object `lads.contract`."""
    config, environment = setting.config, setting.environment
    keep = ("name", "unit", "min", "max", "joint")
    element = lambda row: {key: row[key] for key in keep if key in row}
    high = config.high_level
    return {
        "version": 1,
        "kind": "lads",
        "environment": {"id": environment["id"], "version": environment["version"]},
        "control_period_s": environment["control_period_s"],
        "horizon": config.encoder.horizon,
        "codebook": {"size": config.encoder.codebook_size, "dim": config.encoder.codebook_dim},
        "decision": {"rule": config.decision, "temperature": 1.0, "seed": 0},
        "observation": [element(row) for row in environment["observation"]],
        "action": [element(row) for row in environment["action"]],
        "quaternion_order": environment["quaternion_order"],
        "context": {"words": encoded.max_words, "steps": high.context_steps, "beyond": config.beyond_context},
        "instructions": [{key: row[key] for key in ("id", "text", "sub_tasks", "split")} for row in setting.instructions],
        "language": {
            "encoder": encoded.encoder,
            "sha256": encoded.sha256,
            "dim": encoded.dim,
            "layer": config.language.layer,
            "pooling": "mean" if config.language.pool else "none",
        },
        "network": {"layers": high.layers, "heads": high.heads, "head_dim": high.hidden // high.heads},
        "provenance": {"setting": config.name, "code_version": __version__, **provenance},
    }


def flat_keys(setting):
    """The comma-separated keys that Isaac Lab and mjlab exports carry, at full precision."""
    observation, action = setting.environment["observation"], setting.environment["action"]
    column = lambda rows, key, other="": ",".join(str(row.get(key, other)) for row in rows)
    return {
        "joint_names": column(action, "joint"),
        "observation_names": column(observation, "name"),
        "observation_min": column(observation, "min"),
        "observation_max": column(observation, "max"),
        "action_names": column(action, "name"),
        "action_min": column(action, "min"),
        "action_max": column(action, "max"),
        "action_scale": column(action, "scale", 1.0),
    }


def margin(logits, horizon):
    """The smallest lead of the best over the second best logit, over all decisions of an episode [T, M]."""
    best = np.sort(logits[::horizon], -1)
    return float((best[:, -1] - best[:, -2]).min())


def golden(model, contract_, candidates):
    """The first candidate (instruction index, observations [T, O]) whose decisions are clear, as safetensors bytes.

    An episode longer than the context is cut; a close decision would make the self-test depend on rounding.
    """
    bundle = Bundle(model)
    closest = []
    for instruction, observations in candidates:
        observations = np.ascontiguousarray(observations[: contract_["context"]["steps"]], np.float32)
        plans, actions, logits = bundle.open_loop(contract_, instruction, observations)
        lead = margin(logits, contract_["horizon"])
        if lead >= GOLDEN_MARGIN:
            tensors = {
                "instruction": np.array([instruction], np.int64),
                "observations": observations,
                "plans": plans.astype(np.int64),
                "actions": actions.astype(np.float32),
            }
            return save_safetensors(tensors, metadata={"tolerance": str(GOLDEN_TOLERANCE)})
        closest.append(lead)
    raise UserError(
        f"none of {len(closest)} episodes decides with a margin of {GOLDEN_MARGIN} at every decision"
        f" (best {max(closest, default=0):.4f}); train longer or give more episodes"
    )


def assemble(lads, setting, encoded, provenance, candidates):
    """The complete, checked bundle. `candidates` yields (instruction index, observations) for the golden episode."""
    lads.eval()
    model = graphs.build(lads, encoded, setting.config.encoder.horizon)
    facts = contract(setting, encoded, provenance)
    blob = golden(model, facts, candidates)
    properties = {"lads.contract": json.dumps(facts), "lads.golden": base64.b64encode(blob).decode()}
    helper.set_model_props(model, properties | flat_keys(setting))
    onnx.checker.check_model(model, full_check=True)
    return model


def save(model, path):
    """Writes the bundle and returns its sha256."""
    data = model.SerializeToString(deterministic=True)
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()
