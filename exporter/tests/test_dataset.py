"""Tests the readers: the project's layout and D4RL's, and what each refuses."""

import h5py
import numpy as np
import pytest
import synthetic

from lads_exporter import config, dataset
from lads_exporter.config import UserError


@pytest.fixture(scope="module")
def setting():
    return config.load("configs/tiny.toml")


@pytest.fixture(scope="module")
def kitchen():
    return config.load("configs/kitchen.toml")


def test_safetensors_round_trip(setting, tmp_path):
    data = dataset.load(synthetic.write(tmp_path / "tiny.safetensors", setting), setting)
    assert len(data) == 24 and data.lengths().sum() == len(data.observations)
    assert [setting.instructions[i]["id"] for i in data.instruction[:4]] == ["dl", "lv", "d", "dl"]
    assert 0.009 < data.noise_amplitude().max() <= 0.01001
    assert len(data.sha256) == 64


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"format": None}, "not a lads-dataset file"),
        ({"version": "2"}, "version '2'"),
        ({"environment": "lorel"}, "environment 'lorel'"),
        ({"instructions": None}, "instructions"),
        ({"instructions": "[{"}, "not a lads-dataset file"),
        ({"instructions": '[{"id":"dl"},{"id":"lv"},{"id":"other"}]'}, "'other'"),
        ({"instructions": '[{"id":"dl"},{"id":"lv"},{"id":"dv"}]'}, "unseen instruction 'dv'"),
        ({"instructions": '[{"id":"dl"}]'}, "outside"),
    ],
)
def test_wrong_metadata_is_refused(setting, tmp_path, metadata, message):
    path = synthetic.write(tmp_path / "bad.safetensors", setting, **metadata)
    with pytest.raises(UserError, match=message):
        dataset.load(path, setting)


def test_wrong_files_are_refused(setting, tmp_path):
    with pytest.raises(UserError, match="make collect"):
        dataset.load(tmp_path / "absent.safetensors", setting)
    for name, message in (("text.safetensors", "not a lads-dataset file"), ("text.hdf5", "not a D4RL HDF5 file")):
        (tmp_path / name).write_bytes(b"this is not a dataset, whatever its name says")
        with pytest.raises(UserError, match=message):
            dataset.load(tmp_path / name, setting)
    whole = synthetic.write(tmp_path / "whole.safetensors", setting).read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="not a lads-dataset file"):
        dataset.load(tmp_path / "cut.safetensors", setting)


def d4rl_file(path, episodes, timeouts=True):
    """Writes the layout of kitchen_*-v0.hdf5: 60-d observations, of which the last 30 are the goal."""
    with h5py.File(path, "w") as file:
        rows = np.concatenate(episodes)
        ends = np.zeros(len(rows), bool)
        ends[np.cumsum([len(part) for part in episodes]) - 1] = True
        file["observations"] = np.concatenate([rows, np.full_like(rows, 9.0)], 1)
        file["actions"] = np.random.default_rng(0).uniform(-0.999, 0.999, (len(rows), 9)).astype(np.float32)
        file["terminals"] = np.zeros(len(rows), bool) if timeouts else ends
        file["rewards"] = np.zeros(len(rows), np.float32)
        if timeouts:
            file["timeouts"] = ends
    return path


def d4rl_episode(environment, order, steps=60):
    """Makes an episode that completes the sub-tasks in this order, at equal intervals."""
    rows = np.zeros((steps, 30), np.float32)
    rows[:, 23:30] = [-0.27, 0.35, 1.62, 1, 0, 0, 0]
    for number, name in enumerate(order):
        task = next(task for task in environment["sub_task"] if task["name"] == name)
        rows[(number + 1) * steps // (len(order) + 1) :, task["indices"]] = task["goal"]
    return rows


@pytest.mark.parametrize("timeouts", [True, False])
def test_d4rl_labels_episodes_by_completed_sub_tasks(kitchen, tmp_path, timeouts):
    make = lambda *order, steps=60: d4rl_episode(kitchen.environment, order, steps)
    episodes = [
        make("kettle", "bottom burner", "light switch", "slide cabinet"),  # kbls
        make("microwave", "kettle", "bottom burner", "light switch"),  # the first unseen instruction
        make("microwave", "hinge cabinet", "slide cabinet", "kettle", steps=80),  # mksh in another order
        make("microwave", "kettle"),  # too few
        make("kettle", "light switch", "slide cabinet", "hinge cabinet", steps=300),  # longer than the context
    ]
    data = dataset.load(d4rl_file(tmp_path / "kitchen.hdf5", episodes, timeouts), kitchen)
    assert [kitchen.instructions[i]["id"] for i in data.instruction] == ["kbls", "mksh"]
    assert data.lengths().tolist() == [60, 80] and data.states is None
    assert np.array_equal(data.observations, np.concatenate([episodes[0], episodes[2]]))
    assert data.notes == {"left_out_unseen": 1, "left_out_other_sub_tasks": 1, "left_out_too_long": 1}


def test_d4rl_order_of_completion(kitchen):
    rows = d4rl_episode(kitchen.environment, ["light switch", "kettle", "top burner"])
    found = dataset._completed(rows, kitchen.environment["sub_task"], kitchen.environment["sub_task_radius"])
    assert found == ["light switch", "kettle", "top burner"]
