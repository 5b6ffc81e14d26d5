"""The contract of a bundle, version 2: what a policy expects and promises, as JSON in the model's metadata.

The one place that knows the channels' names and the layout of a contract; everything else reads one through these functions.
`check` holds what every contract keeps: each name once, each number in its range, one action channel, a context that is a
multiple of the plan period. What can fail: a contract that breaks a rule, or is of another version, is a `UserError` that
names the field.
"""

import json
import math

from .config import UserError
from .families import FAMILIES

VERSION = 2
KEY, GOLDEN_KEY, STORAGE_KEY = "lads.contract", "lads.golden", "lads.storage"

# The channels that the exporter's own policies have. Values of a graph with these names are bound to them.
OBSERVATION, ACTION, WORDS, NOISE = "observation", "action", "words", "noise"
OBSERVATIONS, ACTIONS = "observations", "actions"  # a demonstration: what the trajectory encoder reads

ROLES = ("observation", "action", "instruction", "noise", "demonstration")
DTYPES = {"f32": "float32", "u8": "uint8", "i32": "int32"}
LARGEST = 1 << 20


def vector(name, role, elements, **more):
    """A channel of one axis whose elements have names, units and limits."""
    return {"name": name, "role": role, "dtype": "f32", "shape": [len(elements)], **more, "elements": elements}


def array(name, role, shape, dtype="f32", **more):
    """A channel without names for its elements: words, noise, images, demonstrations."""
    return {"name": name, "role": role, "dtype": dtype, "shape": list(shape), **more}


def camera(name, size, **more):
    """Makes the channel of a camera with frames of `size`, rows and columns; `rendering` states how they are drawn where that is known."""
    return array(name, "observation", [*size, 3], "u8", layout="hwc", min=0, max=255, **more)


def element(row):
    """Takes what a contract keeps from a row of an environment file."""
    keep = ("name", "unit", "min", "max", "joint", "interface", "scale", "offset", "physical_unit")
    return {key: row[key] for key in keep if key in row}


def channels(environment, words=None, noise=None, segment=None, image=None, joints=0):
    """Lists the channels of a policy on one observation vector.

    words: [L, E] of an instruction; noise: the shape of one draw; segment: the steps that a trajectory encoder reads.
    image: the channel of a camera, which is observed in place of the vector, or beside its first `joints` elements.
    """
    observation, action = ([element(row) for row in environment[key]] for key in (OBSERVATION, ACTION))
    reference = environment.get("reference", "not stated")
    own = observation[:joints] if image else observation
    found = [image] if image else []
    found += [vector(OBSERVATION, "observation", own, quaternion_order=environment["quaternion_order"])] if own else []
    if words:
        found.append(array(WORDS, "instruction", words))
    if noise:
        found.append(array(NOISE, "noise", noise))
    if segment:
        found.append(array(OBSERVATIONS, "demonstration", [segment, len(observation)]))
        found.append(array(ACTIONS, "demonstration", [segment, len(action)]))
    return [*found, vector(ACTION, "action", action, reference=reference)]


def properties(model):
    """Returns the metadata of an ONNX model."""
    return {row.key: row.value for row in model.metadata_props}


def of(model, path="the model"):
    """Returns the checked contract of an ONNX model; `path` is its name in errors."""
    text = properties(model).get(KEY)
    if text is None:
        raise UserError(f"{path}: no contract in its metadata; it is not a bundle of this exporter")
    try:
        found = json.loads(text)
        version = found["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: its contract cannot be read ({type(error).__name__})") from error
    if version == 1:
        raise UserError(f"{path}: contract version 1; run: python -m lads_exporter upgrade {path}")
    check(found, path)
    return found


def of_role(contract, role):
    """Returns all channels of a role, in order."""
    return [row for row in contract["channels"] if row["role"] == role]


def action(contract):
    """Returns the action channel."""
    return of_role(contract, "action")[0]


def seen(contract):
    """Returns the channels of a policy that observes one vector, the frames of one camera, or both -> the vector or None, the camera or None."""
    found = of_role(contract, "observation")
    vectors, cameras = [row for row in found if "elements" in row], [row for row in found if row.get("layout") == "hwc"]
    if len(vectors) > 1 or len(cameras) > 1 or len(vectors) + len(cameras) != len(found):
        raise UserError(f"the policy observes {', '.join(row['name'] for row in found)}, not one vector, the frames of one camera, or both")
    return vectors[0] if vectors else None, cameras[0] if cameras else None


def observation(contract):
    """Returns the only observation channel of a policy that has one vector."""
    found = of_role(contract, "observation")
    if len(found) != 1 or "elements" not in found[0]:
        raise UserError(f"the policy observes {', '.join(row['name'] for row in found)}, not one vector")
    return found[0]


def limits(channel):
    """Returns the limits of a channel -> low, high: a number for each element of a vector, or one for all."""
    rows = channel.get("elements") or [channel]
    return tuple([row[key] for row in rows] for key in ("min", "max"))


def words(contract):
    """Returns the shape [L, E] of an instruction, or None where the policy has no instructions."""
    found = of_role(contract, "instruction")
    return found[0]["shape"] if found else None


def period(contract):
    """Returns the control steps from one plan to the next; 1 where a plan is made at every step or there are none."""
    return contract["family"].get("horizon", 1)


def rule(contract):
    """Returns the rule that decides a plan: `argmax`, `sample`, `mean`, or None where none is decided."""
    return contract["family"].get("decision", {}).get("rule")


def splits(contract):
    """Lists what an evaluation asks of each instruction: {id, text, sub_tasks, split}."""
    rows = contract.get("evaluation", {}).get("instructions", [])
    return [{**known, **asked} for known, asked in zip(contract.get("instructions", []), rows, strict=True)]


def _need(condition, where, problem):
    if not condition:
        raise UserError(f"{where}: contract: {problem}")


def _number(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _length(value):
    return type(value) is int and 1 <= value <= LARGEST


def _distinct(rows, key, field, where):
    names = [row.get(key) for row in rows]
    _need(all(isinstance(name, str) and name.strip() for name in names), where, f"`{field}`: a `{key}` is empty or missing")
    repeated = next((name for name in names if names.count(name) > 1), None)
    _need(repeated is None, where, f"`{field}` repeats {repeated!r}")


def _range(row, field, where):
    low, high = row.get("min"), row.get("max")
    _need(_number(low) and _number(high) and low < high, where, f"`{field}` has limits {low} to {high}, which is not a range")


def _channel(row, where):
    field = f"channels.{row['name']}"
    role, shape, elements = row.get("role"), row.get("shape"), row.get("elements")
    _need(role in ROLES, where, f"`{field}.role` is {role!r}; known: {', '.join(ROLES)}")
    _need(row.get("dtype") in list(DTYPES), where, f"`{field}.dtype` is {row.get('dtype')!r}; known: {', '.join(DTYPES)}")
    good = isinstance(shape, list) and 1 <= len(shape) <= 4 and all(_length(size) for size in shape)
    _need(good, where, f"`{field}.shape` is {shape}; it must be 1 to 4 positive lengths")
    if role == "observation" and elements is None:
        _range(row, field, where)
    if role == "action":
        _need(row["dtype"] == "f32" and elements is not None, where, f"`{field}` must be f32 with named elements")
        _need(isinstance(row.get("reference"), str), where, f"`{field}.reference` does not say what the action is relative to")
    if elements is not None:
        _need([len(elements)] == shape, where, f"`{field}` has {len(elements)} elements and shape {shape}")
        _distinct(elements, "name", field, where)
        for one in elements:
            _range(one, f"{field}.{one['name']}", where)


def _positive(value, fields, where):
    for field in fields:
        size = value
        for part in field.split("."):
            size = size.get(part) if isinstance(size, dict) else None
        _need(_length(size), where, f"`{field}` is {size!r}; it must be 1 to {LARGEST}")


def _objects(rows):
    return isinstance(rows, list) and all(isinstance(row, dict) for row in rows)


def _forms(found, where):
    """Refuses parts that are no objects or lists of objects, so that the rules may read their fields."""
    parts = {key: found[key] for key in ("environment", "family", "language", "evaluation", "network") if key in found}
    parts |= {"context": found["context"]} if found.get("context") is not None else {}
    for key, part in parts.items():
        _need(isinstance(part, dict), where, f"`{key}` is no object")
    lists = {key: found[key] for key in ("channels", "instructions", "states") if key in found}
    lists["evaluation.instructions"] = found.get("evaluation", {}).get("instructions", [])
    for key, rows in lists.items():
        _need(_objects(rows), where, f"`{key}` is no list of objects")
    for row in found["channels"]:
        _need(row.get("elements") is None or _objects(row["elements"]), where, f"`channels.{row.get('name')}.elements` is no list of objects")


def _family(found, where):
    given = found["family"]
    kind = given.get("kind")
    _need(isinstance(kind, str) and kind in FAMILIES, where, f"`family.kind` is {kind!r}; known: {', '.join(FAMILIES)}")
    family = FAMILIES[kind]
    missing = [name for name in family.fields if name not in given]
    _need(not missing, where, f"`family` lacks {', '.join(missing)}")
    _positive(given, [*family.lengths, *(name for name in family.optional if name.split(".")[0] in given)], where)
    for key, rules in family.rules.items():
        _need(isinstance(given[key], dict), where, f"`family.{key}` is no object")
        rule = given[key].get("rule")
        _need(rule in rules, where, f"`family.{key}.rule` is {rule!r}; known: {', '.join(rules)}")
        seed, temperature = given[key].get("seed"), given[key].get("temperature", 1.0)
        _need(type(seed) is int and 0 <= seed < 1 << 64, where, f"`family.{key}.seed` is {seed!r}; it must be a whole number of 64 bits")
        _need(_number(temperature), where, f"`family.{key}.temperature` is {temperature!r}, no number")
    _positive(given, [key for key in ("features",) if key in given], where)


def _states(found, where):
    states = found.get("states", [])
    _need(not states or found["family"]["kind"] == "plain", where, "`states`: only a plain policy names its states")
    _distinct(states, "name", "states", where)
    for row in states:
        field = f"states.{row['name']}"
        if row.get("kind") == "ring":
            _positive(row, ["rows"], where)
            sources = [one["name"] for one in of_role(found, "observation")]
            _need(row.get("source") in (None, *sources), where, f"`{field}.source` {row.get('source')!r} is not an observation channel")
            _need(row.get("fill") in ("first", "zero"), where, f"`{field}.fill` is {row.get('fill')!r}; known: first, zero")
        else:
            _need(row.get("kind") == "plain", where, f"`{field}.kind` is {row.get('kind')!r}; known: plain, ring")
            shape = row.get("shape")
            _need(isinstance(shape, list) and shape and all(_length(size) for size in shape), where, f"`{field}.shape` is {shape}")
        cleared = row.get("cleared_by", "episode")
        _need(cleared in ("episode", "instruction"), where, f"`{field}.cleared_by` is {cleared!r}; known: episode, instruction")


def _instructions(found, where):
    known, asked = found.get("instructions", []), found.get("evaluation", {}).get("instructions", [])
    _distinct(known, "id", "instructions", where)
    _need(all(str(row.get("text", "")).strip() for row in known), where, "`instructions`: a text is empty")
    if words(found) is None:
        _need(not known and "language" not in found, where, "`instructions` or `language` without an instruction channel")
        return
    _need(known, where, "`instructions` is empty")
    _positive(found, ["language.dim"], where)
    _need(words(found)[-1] == found["language"]["dim"], where, "the instruction channel's words are not as long as `language.dim`")
    _need(len(asked) in (0, len(known)), where, f"`evaluation` is of {len(asked)} instructions, there are {len(known)}")


def _context(found, where):
    context = found.get("context")
    if context is None:
        return
    _positive(context, ["steps"], where)
    _need(context.get("beyond") in ("restart", "refuse"), where, f"`context.beyond` is {context.get('beyond')!r}; known: restart, refuse")
    if words(found) is not None:
        _need(context.get("words") == words(found)[0], where, "`context.words` is not the length of the instruction channel")
    steps, plan = context["steps"], period(found)
    _need(steps % plan == 0, where, f"`context.steps` is {steps}, no multiple of the plan period of {plan} control steps")


def check(found, where="the model"):
    """Refuses a contract that breaks a rule, by a `UserError` that names the field."""
    _need(isinstance(found, dict) and found.get("version") == VERSION, where, f"version is not {VERSION}")
    for key in ("environment", "family", "channels", "control_period_s"):
        _need(key in found, where, f"missing field `{key}`")
    _forms(found, where)
    _need(_number(found["control_period_s"]) and found["control_period_s"] > 0, where, "`control_period_s` is not positive")
    _distinct(found["channels"], "name", "channels", where)
    for row in found["channels"]:
        _channel(row, where)
    count = {role: len(of_role(found, role)) for role in ROLES}
    _need(count["action"] == 1, where, f"{count['action']} action channels; there must be one")
    _need(count["observation"] >= 1, where, "no observation channel")
    for role in ("instruction", "noise"):
        _need(count[role] <= 1, where, f"{count[role]} {role} channels; there may be one")
    _family(found, where)
    _states(found, where)
    _instructions(found, where)
    _context(found, where)
    if "network" in found:
        _positive(found, ["network.layers", "network.heads", "network.head_dim"], where)
