"""A missing extra is one line that says what to install."""

import sys

import pytest

from lads_exporter import config, dataset, language
from lads_exporter.config import UserError
from lads_exporter.tables import run


def test_d4rl_files_need_h5py(monkeypatch, tmp_path):
    setting = config.load("configs/kitchen.toml")
    path = tmp_path / "kitchen.hdf5"
    path.touch()
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UserError, match=r"kitchen\.hdf5: .* 'exporter\[d4rl\]'"):
        dataset.load(path, setting)


def test_the_language_encoder_needs_transformers(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(UserError, match=r"'exporter\[language\]'"):
        language.load("all-minilm-l6-v2")


def test_the_engine_of_clusters_needs_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "lads_exporter.tables.on_ray", raising=False)
    with pytest.raises(UserError, match=r"'exporter\[cluster\]'"):
        run.open_engine("ray", None, None)
