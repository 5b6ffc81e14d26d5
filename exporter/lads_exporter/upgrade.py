"""Upgrades a bundle of contract version 1 to version 2: new metadata, the same graphs and weights to the bit.

What version 1 does not say, an action's meaning and the interface of an element, is taken from the environment file of the same
id and version; where there is none, the contract says that it is not stated. Files beside the bundle that name its sha256 (the
reference rollouts, results, the model card) are rewritten with the new one when the bundle is upgraded in place. What can fail:
a file that is not a bundle of version 1 is refused and nothing is written.
"""

import base64
import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
from onnx import helper
from safetensors.numpy import load as load_safetensors, save as save_safetensors

from . import bundle, config, contract as contracts, reference
from .config import UserError
from .output import write_atomically

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def environment_file(known, path=None):
    """Finds the environment file of a contract's `environment`: `path`, or the one in configs; None where there is none."""
    for candidate in [Path(path)] if path else sorted(CONFIGS.glob("*.environment.toml")):
        found = config.read_toml(candidate)
        if (found.get("id"), found.get("version")) == (known["id"], known["version"]):
            return found
    if path:
        raise UserError(f"{path}: not of the environment {known['id']}, version {known['version']}")
    return None


def _meant(rows, stated):
    """Completes elements of version 1 with what the environment file says beyond them; the bundle's own fields win."""
    by_name = {row["name"]: row for row in stated}
    return [contracts.element(by_name.get(row["name"], {}) | row) for row in rows]


def contract(old, environment=None):
    """Upgrades a contract from version 1 to version 2."""
    stated = environment or {"observation": [], "action": []}
    own = {
        "quaternion_order": old["quaternion_order"],
        "reference": stated.get("reference", "not stated"),
        "observation": _meant(old["observation"], stated["observation"]),
        "action": _meant(old["action"], stated["action"]),
    }
    words = [old["context"]["words"], old["language"]["dim"]]
    instructions = old["instructions"]
    return {
        "version": contracts.VERSION,
        "family": {"kind": old["kind"], **{key: old[key] for key in ("horizon", "codebook", "decision")}},
        "environment": old["environment"],
        "control_period_s": old["control_period_s"],
        "channels": contracts.channels(own, words=words, segment=old["horizon"]),
        "context": old["context"],
        "instructions": [{key: row[key] for key in ("id", "text")} for row in instructions],
        "language": {"pooling": "none"} | old["language"],
        "network": old["network"],
        "evaluation": {"instructions": [{key: row[key] for key in ("sub_tasks", "split")} for row in instructions]},
        "provenance": old["provenance"],
    }


def golden(blob):
    """Upgrades a golden episode, in base64, from version 1 to version 2."""
    data = base64.b64decode(blob)
    old = load_safetensors(data)
    tensors = {
        "instruction": old["instruction"],
        f"channel.{contracts.OBSERVATION}": old["observations"],
        "selected": old["plans"].astype(np.int64),
        "actions": old["actions"],
    }
    return base64.b64encode(save_safetensors(tensors, metadata={"tolerance": _tolerance(data)})).decode()


def _tolerance(data):
    length = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + length])["__metadata__"]["tolerance"]


def read(path):
    """Reads a bundle -> the ONNX model and its contract, of whatever version."""
    try:
        model = onnx.load_from_string(Path(path).read_bytes())
        found = json.loads(contracts.properties(model)[contracts.KEY])
        version = found["version"]
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except Exception as error:
        raise UserError(f"{path}: no bundle: an ONNX file with a contract in its metadata is needed ({type(error).__name__})") from error
    if version not in (1, contracts.VERSION):
        raise UserError(f"{path}: contract version {version!r}; this exporter upgrades version 1 to {contracts.VERSION}")
    return model, found


def model(old, stated=None, where="the model"):
    """Rewrites the metadata of an ONNX model with a contract of version 1, in place -> the contract of version 2.

    stated: the contract's `environment` -> the environment file's table, or None.
    """
    properties = contracts.properties(old)
    try:
        before = json.loads(properties[contracts.KEY])
        found = contract(before, stated(before["environment"]) if stated else None)
        blob = golden(properties[contracts.GOLDEN_KEY])
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{where}: the contract or the golden episode is not that of version 1 ({type(error).__name__}: {error})") from error
    contracts.check(found, where)
    new = properties | {contracts.KEY: json.dumps(found), contracts.GOLDEN_KEY: blob} | bundle.flat_keys(found)
    helper.set_model_props(old, new)
    return found


def rebind(path, before, after, contract):
    """Puts the bundle's new sha256 into the files beside it that name the old one -> their names."""
    path, changed = Path(path), []
    for suffix in (".reference.json", ".results.json", ".md"):
        beside = path.with_suffix(suffix)
        text = beside.read_text(encoding="utf-8") if beside.is_file() else ""
        if before not in text:
            continue
        text = text.replace(before, after)
        if suffix == ".reference.json":
            text = recorded(_line(text, "purpose_sha256", reference.purpose_sha256(contract)), contract)
        write_atomically(beside, text.encode())
        changed.append(beside.name)
    return changed


def _line(text, key, value):
    """Replaces the text of a key at the head of a reference, which has one key a line."""
    start = text.index(f'"{key}": "') + len(key) + 5
    return text[:start] + value + text[text.index('"', start) :]


def recorded(text, contract):
    """Replaces the contract that a reference of version 2 records at its head; one of version 1 records none and stays as it is."""
    start = text.find('\n "contract": ')
    if start < 0:
        return text
    end = text.index("\n", start + 1)
    return f'{text[:start]}\n "contract": {json.dumps(contract, ensure_ascii=False)},{text[end:]}'


def write(path, output=None, environment=None):
    """Upgrades the bundle at `path`, in place unless `output` names another file -> what to tell the user."""
    old, found = read(path)
    if found["version"] == contracts.VERSION:
        contracts.check(found, path)
        return f"{path}: contract version {contracts.VERSION} already; nothing to do"
    after = model(old, lambda known: environment_file(known, environment), path)
    before = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    sha256 = bundle.save(old, output or path)
    changed = [] if output and Path(output).resolve() != Path(path).resolve() else rebind(path, before, sha256, after)
    beside = f"; the new sha256 is in {', '.join(changed)} too" if changed else ""
    return f"{output or path}: contract version {contracts.VERSION}, sha256 {sha256}{beside}"
