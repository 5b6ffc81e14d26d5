"""Tests the rules of a contract: every broken rule is refused with the field's name."""

import copy

import pytest

from lads_exporter import contract as contracts, kinds
from lads_exporter.config import UserError

LADS = kinds.KINDS["lads"].contract(kinds.Sizes(), 0)
STACKED = kinds.KINDS["stacked"].contract(kinds.Sizes(), 0)
LCSD = kinds.KINDS["lcsd"].contract(kinds.Sizes(), 0)


def channel(contract, name):
    return next(row for row in contract["channels"] if row["name"] == name)


def put(path, value):
    """Changes a contract: the value at a path; the number or name of each part, channels by name."""

    def change(contract):
        *parts, last = path
        for part in parts:
            named = isinstance(contract, list) and isinstance(part, str)
            contract = next(row for row in contract if row["name"] == part) if named else contract[part]
        contract[last] = value

    return change


BROKEN = [
    (LADS, put(["version"], 3), "version is not 2"),
    (LADS, lambda c: c.pop("family"), "missing field `family`"),
    (LADS, put(["control_period_s"], 0), "`control_period_s` is not positive"),
    (LADS, put(["family", "kind"], "other"), "`family.kind` is 'other'"),
    (LADS, lambda c: c["family"].pop("codebook"), "`family` lacks codebook"),
    (LADS, put(["family", "codebook", "size"], 0), "`codebook.size` is 0"),
    (LADS, put(["family", "decision", "rule"], "mean"), "`family.decision.rule` is 'mean'"),
    (LCSD, put(["family", "noise", "seed"], "x"), "`family.noise.seed`"),
    (LCSD, put(["family", "denoise", "steps"], 1 << 32), "`denoise.steps` is 4294967296"),
    (LADS, put(["context", "steps"], 41), "`context.steps` is 41, no multiple of the plan period of 4"),
    (LADS, put(["context", "beyond"], "stop"), "`context.beyond` is 'stop'"),
    (LADS, put(["context", "words"], 7), "`context.words`"),
    (LADS, lambda c: c["channels"].append(copy.deepcopy(channel(c, "action"))), "`channels` repeats 'action'"),
    (LADS, lambda c: c["channels"].remove(channel(c, "action")), "0 action channels"),
    (LADS, lambda c: c["channels"].remove(channel(c, "observation")), "no observation channel"),
    (LADS, put(["channels", "observation", "role"], "sight"), "`channels.observation.role` is 'sight'"),
    (LADS, put(["channels", "observation", "dtype"], "f64"), "`channels.observation.dtype` is 'f64'"),
    (LADS, put(["channels", "observation", "shape"], [9]), "8 elements and shape"),
    (LADS, put(["channels", "words", "shape"], [0, 12]), "`channels.words.shape`"),
    (LADS, put(["channels", "observation", "elements", 0, "min"], 5.0), "`channels.observation.joint1` has limits"),
    (LADS, lambda c: channel(c, "action").pop("reference"), "`channels.action.reference`"),
    (LADS, put(["language", "dim"], 13), "as `language.dim`"),
    (LADS, put(["instructions", 0, "text"], " "), "a text is empty"),
    (LADS, put(["instructions", 0, "id"], "close"), "`instructions` repeats 'close'"),
    (LADS, put(["evaluation", "instructions"], [{}]), "`evaluation` is of 1 instructions"),
    (LADS, put(["states"], [{"name": "h"}]), "only a plain policy"),
    (STACKED, put(["states", "stack", "source"], "absent"), "`states.stack.source` 'absent'"),
    (STACKED, put(["states", "stack", "fill"], "last"), "`states.stack.fill`"),
    (STACKED, put(["states", "stack", "kind"], "kv"), "`states.stack.kind`"),
    (STACKED, put(["states", "stack", "cleared_by"], "call"), "`states.stack.cleared_by`"),
    (STACKED, put(["instructions"], [{"id": "a", "text": "b"}]), "without an instruction channel"),
]


@pytest.mark.parametrize(("contract", "change", "message"), BROKEN, ids=[row[2] for row in BROKEN])
def test_a_broken_rule_is_named(contract, change, message):
    contracts.check(contract)
    broken = copy.deepcopy(contract)
    change(broken)
    with pytest.raises(UserError) as refused:
        contracts.check(broken)
    assert message in str(refused.value)


def places(value, path=()):
    """Yields the path of every value inside a value; of a list, of the first two rows."""
    if path:
        yield path
    inside = value.items() if isinstance(value, dict) else list(enumerate(value))[:2] if isinstance(value, list) else ()
    for key, one in inside:
        yield from places(one, (*path, key))


@pytest.mark.parametrize("kind", ["lads", "stacked", "recurrent", "lcsd", "images", "vae_history", "sighted"])
def test_whatever_stands_in_a_place_is_taken_or_refused(kind):
    """Tests that a value of any form in any place of a contract ends in no other error than a `UserError`."""
    known = kinds.KINDS[kind]
    contract = known.contract(known.sizes, 0)
    refused = 0
    for *parts, last in places(contract):
        for value in (None, "x", 3, -1.5, [], {}, True, [[]], [{}]):
            broken = copy.deepcopy(contract)
            inside = broken
            for part in parts:
                inside = inside[part]
            inside[last] = value
            try:
                contracts.check(broken)
            except UserError:
                refused += 1
    assert refused > 100


def test_images_have_limits_as_a_whole():
    image = contracts.array("camera", "observation", [4, 4, 3], "u8", layout="hwc", min=0, max=255)
    seen = copy.deepcopy(STACKED)
    seen["channels"].insert(0, image)
    contracts.check(seen)
    assert contracts.limits(image) == ([0], [255])
    del image["max"]
    with pytest.raises(UserError, match="`channels.camera` has limits 0 to None"):
        contracts.check(seen)
