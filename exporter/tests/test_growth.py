"""Tests random bundles of growing size: one dimension grows, everything else stays."""

import json

import onnx
import pytest

from lads_exporter import config, contract as contracts, growth


def contract(path):
    return contracts.of(onnx.load(path))


@pytest.mark.parametrize("series", growth.SERIES)
def test_only_one_dimension_grows(series):
    base = config.load("configs/kitchen.toml")
    first, last = (
        config.from_tables(*growth.table_of(base, series, value), "growth")
        for value in (growth.SERIES[series][0], growth.SERIES[series][-1])
    )
    sizes = lambda setting: {
        "layers": setting.config.high_level.layers,
        "width": (setting.config.high_level.hidden, setting.config.low_level.hidden),
        "codebook": setting.config.encoder.codebook_size,
        "actions": setting.action_len,
    }
    changed = {name for name in growth.SERIES if sizes(first)[name] != sizes(last)[name]}
    assert changed == {series}
    assert first.observation_len == last.observation_len == base.observation_len


def test_bundles_and_their_index(tmp_path, monkeypatch):
    monkeypatch.setattr(growth, "SERIES", {"actions": [2, 5], "codebook": [8]})
    written = list(growth.export(config.load("configs/tiny.toml"), tmp_path, steps=8))
    index = json.loads((tmp_path / "index.json").read_text())
    assert [name for _, _, name in index] == written == ["actions-2.onnx", "actions-5.onnx", "codebook-8.onnx"]
    assert [contracts.action(contract(tmp_path / name))["shape"][0] for name in written] == [2, 5, 3]
    assert contract(tmp_path / "codebook-8.onnx")["family"]["codebook"]["size"] == 8
