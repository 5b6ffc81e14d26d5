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

from . import __version__, contract as contracts, systems, twin
from .config import UserError
from .output import write_atomically

GOLDEN_TOLERANCE = 1e-4
GOLDEN_MARGIN = 1e-2  # smallest difference between the two best logits at any decision of a golden episode, if an episode has it
LEAST_MARGIN = 1e-3  # what the clearest one must have else
CLOSE_MARGIN = 1e-5  # what it must have where no first decision has that: a collapsed codebook; ten times what evaluators differ by


def describe(family, environment, instructions, encoded, provenance, layer=-1, pooling="none", **parts):
    """Makes the JSON object `lads.contract` of any family; `parts` are further fields, those that are None are left out.

    instructions: rows {id, text, sub_tasks, split}, none for a policy without.
    """
    language = None
    if instructions:
        language = {"encoder": encoded.encoder, "sha256": encoded.sha256, "dim": encoded.dim, "layer": layer, "pooling": pooling}
    fields = {
        "version": contracts.VERSION,
        "family": family,
        "environment": {"id": environment["id"], "version": environment["version"]},
        "control_period_s": environment["control_period_s"],
        "channels": parts.pop("channels"),
        "states": parts.pop("states", None),
        "context": parts.pop("context", None),
        "instructions": [{key: row[key] for key in ("id", "text")} for row in instructions] or None,
        "language": language,
        "network": parts.pop("network", None),
        "evaluation": {"instructions": [{key: row[key] for key in ("sub_tasks", "split")} for row in instructions]} if instructions else None,
        "provenance": {"code_version": __version__, **provenance},
    }
    assert not parts, parts
    found = {key: value for key, value in fields.items() if value is not None}
    contracts.check(found, environment["id"])
    return found


def contract(setting, encoded, provenance, exported):
    """Makes the contract of a trained policy."""
    config, environment = setting.config, setting.environment
    high = config.high_level
    camera = config.images.channel or config.pretrained.channel
    image = contracts.camera(camera, setting.rendering["size"], rendering=setting.rendering) if camera else None
    return describe(
        exported.family,
        environment,
        setting.instructions,
        encoded,
        {"setting": config.name, **provenance},
        layer=config.language.layer,
        pooling="mean" if config.language.pool else "none",
        channels=contracts.channels(environment, [encoded.max_words, encoded.dim], exported.noise, exported.segment, image, config.pretrained.joints),
        context={"words": encoded.max_words, "steps": high.context_steps, "beyond": config.beyond_context},
        network={"layers": high.layers, "heads": high.heads, "head_dim": high.hidden // high.heads},
    )


def flat_keys(found):
    """Makes the comma-separated keys that Isaac Lab and mjlab exports carry, at full precision; none for what is not a vector."""
    action = contracts.action(found)["elements"]
    column = lambda rows, key, other="": ",".join(str(row.get(key, other)) for row in rows)
    keys = {
        "joint_names": column(action, "joint"),
        "action_names": column(action, "name"),
        "action_min": column(action, "min"),
        "action_max": column(action, "max"),
        "action_scale": column(action, "scale", 1.0),
    }
    seen = contracts.of_role(found, "observation")
    if len(seen) == 1 and "elements" in seen[0]:
        rows = seen[0]["elements"]
        keys |= {"observation_names": column(rows, "name"), "observation_min": column(rows, "min"), "observation_max": column(rows, "max")}
    return keys


def golden_tensors(rollout, instruction, channels):
    """Makes the tensors of a golden episode: {`channel.<name>`: [T, ...]}, what the policy did, and of which instruction."""
    tensors = {f"channel.{name}": rows for name, rows in channels.items()} | rollout.tensors()
    return tensors if instruction is None else tensors | {"instruction": np.array([instruction], np.int64)}


def golden(model, candidates):
    """Records the first candidate whose decisions are clear, or the clearest one, as safetensors bytes. `model` has its contract in it. Where none
    is clear to its end, the one that is for longest is recorded up to there.

    A candidate is an instruction's index, None for a policy without, and {name of a channel: [T, ...]}, or the array of the one
    observation. An episode longer than the context is cut; a close decision would make the self-test depend on rounding.
    """
    runner = twin.Twin(model)
    rows = {row["name"]: row for row in contracts.of_role(runner.contract, "observation")}
    best, clearest = 0.0, None
    longest = {least: (0, None, None) for least in (LEAST_MARGIN, CLOSE_MARGIN)}
    tried = 0
    for instruction, given in candidates:
        given = given if isinstance(given, dict) else {next(iter(rows)): given}
        kind = lambda name: contracts.DTYPES[rows[name]["dtype"]]
        channels = {name: np.ascontiguousarray(array[: runner.steps], kind(name)) for name, array in given.items()}
        rollout = twin.open_loop(runner, instruction, channels)
        tried += 1
        if rollout.margin > best:
            best, clearest = rollout.margin, golden_tensors(rollout, instruction, channels)
        if best >= GOLDEN_MARGIN:
            break
        for least, row in longest.items():
            longest[least] = max(row, (rollout.clear_until(least), instruction, channels), key=lambda row: row[0])
    for least, (steps, instruction, channels) in longest.items():
        if best < least and steps:
            channels = {name: rows[:steps] for name, rows in channels.items()}
            rollout = twin.open_loop(runner, instruction, channels)
            best, clearest = rollout.margin, golden_tensors(rollout, instruction, channels)
    if best < CLOSE_MARGIN:
        raise UserError(
            f"none of {tried} episodes decides with a margin of {CLOSE_MARGIN} even at its first decision (best {best:.2g}); train longer or give more episodes"
        )
    return save_safetensors(clearest, metadata={"tolerance": str(GOLDEN_TOLERANCE)})


def seal(model, found, candidates):
    """Puts a contract and a golden episode into a model of entry graphs, and checks the whole."""
    helper.set_model_props(model, {contracts.KEY: json.dumps(found)})
    blob = base64.b64encode(golden(model, candidates)).decode()
    helper.set_model_props(model, {contracts.KEY: json.dumps(found), contracts.GOLDEN_KEY: blob} | flat_keys(found))
    onnx.checker.check_model(model, full_check=True)
    return model


def assemble(networks, setting, encoded, provenance, candidates):
    """Makes the complete, checked bundle. `candidates` yields (instruction index, observations) for the golden episode."""
    networks.eval()
    exported = systems.of(setting.config).export(networks, setting, encoded)
    return seal(exported.model, contract(setting, encoded, provenance, exported), candidates)


def save(model, path):
    """Writes the bundle and returns its sha256."""
    data = model.SerializeToString(deterministic=True)
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()
