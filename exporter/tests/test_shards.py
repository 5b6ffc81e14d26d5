"""Tests that the parts of an evaluation make the numbers of a whole one, against results that lads-run wrote; what is refused."""

import json
from pathlib import Path

import pytest

from lads_exporter.config import UserError
from lads_exporter.tables import shards

MODELS = Path(__file__).parents[2] / "models"


def parts_of(name):
    """Takes results apart, as lads-run writes them for one instruction each -> (whole, parts, ids)."""
    whole = json.loads((MODELS / f"{name}.results.json").read_text())
    parts = [whole | {"instructions": [row], "splits": dict.fromkeys(whole["splits"])} for row in whole["instructions"]]
    return whole, parts, [row["id"] for row in whole["instructions"]]


@pytest.mark.parametrize("name", ["kitchen", "kitchen-small", "kitchen-image", "lorel", "lorel-image"])
def test_parts_make_the_numbers_of_the_whole(name):
    whole, parts, ids = parts_of(name)
    merged = shards.merge(parts, ids)
    assert merged["instructions"] == whole["instructions"] and merged["bundle_sha256"] == whole["bundle_sha256"]
    assert list(merged["splits"]) == list(whole["splits"])
    for split, got in merged["splits"].items():
        assert got == {key: whole["splits"][split][key] for key in got}
        assert set(whole["splits"][split]) - set(got) == {"completions", "un_instructed_completions"}


def test_a_split_without_episodes_has_no_rates():
    _, parts, ids = parts_of("kitchen")
    unseen = shards.merge(parts[:1], ids[:1])["splits"]["unseen"]
    assert unseen["episodes"] == 0 and unseen["n_rate"] is None and unseen["n_rate_standard_error"] is None and unseen["full_success_interval"] == [0.0, 1.0]


def test_parts_of_other_evaluations_are_refused():
    _, parts, ids = parts_of("kitchen")
    with pytest.raises(UserError, match=f"an evaluation's parts are of {ids[0]}, not of {ids[0]}, {ids[1]}"):
        shards.merge(parts[:1], ids[:2])
    with pytest.raises(UserError, match="parts differ in seed: 9 and 0"):
        shards.merge([parts[0], parts[1] | {"seed": 9}], ids[:2])
