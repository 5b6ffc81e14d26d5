"""Tests that the Python table gives the trajectories that the Rust table is tested against."""

import json
from pathlib import Path

import numpy as np
import pytest
from lads_exporter.config import UserError
from lads_exporter.lorel_table import ASSETS, LorelTable

RECORDED = Path(__file__).parents[2] / "sim-harness/tests/data/lorel-trajectories.json"


@pytest.mark.skipif(not ASSETS.is_dir(), reason="needs make setup")
def test_recorded_trajectories():
    table = LorelTable()
    for one in json.loads(RECORDED.read_text()):
        start = table.reset(one["seed"], one["commanded"])
        assert np.abs(start - one["start"]).max() < 1e-5
        states = [table.step(np.array(action)) for action in one["actions"]]
        assert np.abs(states[4] - one["after_5"]).max() < 1e-4
        assert np.abs(states[19] - one["after_20"]).max() < 1e-3
        assert [task for task in table.SUB_TASKS if table.succeeded([task])] == one["succeeded"]
        assert table.succeeded(one["succeeded"]) and set(one["succeeded"]) <= set(table.completions) and table.steps == 20


def test_there_is_no_noise():
    with pytest.raises(UserError, match="noise"):
        LorelTable("v1")
