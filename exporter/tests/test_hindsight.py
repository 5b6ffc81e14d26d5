"""Tests relabelled parts of trajectories: every label is true of its part, and held-out trajectories stay held out."""

import numpy as np
import pytest
from lads_exporter import config, hindsight
from lads_exporter.config import UserError
from lads_exporter.dataset import Dataset

LENGTH, COUNT = 20, 60


@pytest.fixture(scope="module")
def setting():
    return config.load("configs/lorel.toml")


def wander(setting, trajectories=200, seed=0):
    draw = np.random.default_rng(seed)
    observations = np.cumsum(draw.normal(0, 0.02, (trajectories, LENGTH, setting.observation_len)), 1).astype(np.float32)
    observations[:, :, 0] = np.arange(trajectories)[:, None]  # tells which trajectory it is
    actions = draw.uniform(-1, 1, (trajectories * LENGTH, setting.action_len)).astype(np.float32)
    flat = observations.reshape(-1, setting.observation_len)
    offsets = np.arange(trajectories + 1) * LENGTH
    return Dataset(flat, None, actions, actions, offsets, np.zeros(trajectories, int), "0" * 64, texts=["unused"])


def phrases(sentence):
    """Lists the sub-tasks of a label: a direction alone belongs to the mug before it."""
    names, head = [], ""
    for phrase in sentence.split(" and "):
        if " " in phrase:
            head = phrase.rsplit(" ", 1)[0]
            names.append(phrase)
        else:
            names.append(f"{head} {phrase}")
    return names


def test_every_label_is_true_of_its_part(setting):
    source = wander(setting)
    made = hindsight.relabel(source, setting, COUNT, 11, 3, seed=1)
    sub_tasks = {row["name"]: row for row in setting.environment["sub_task"]}
    assert len(made) == COUNT and made.offsets[-1] == len(made.observations) == len(made.actions)
    starts = set()
    for episode in range(COUNT):
        part = made.observations[made.rows(episode)]
        names = phrases(made.texts[made.instruction[episode]])
        assert 1 <= len(names) == len(set(names)) <= 3
        for name in names:
            row = sub_tasks[name]
            assert row["sign"] * (part[-1, row["element"]] - part[0, row["element"]]) > row["threshold"], name
        trajectory = int(part[0, 0])
        assert np.array_equal(part, source.observations[source.rows(trajectory)][-len(part) :])
        every = setting.config.data.validation_every
        assert (trajectory % every == every - 1) == (episode % every == every - 1), "held out stays held out"
        starts.add(LENGTH - len(part))
    assert 0 in starts and len(starts) > 3 and max(starts) <= 11
    again = hindsight.relabel(source, setting, COUNT, 11, 3, seed=1)
    assert again.texts == made.texts and np.array_equal(again.observations, made.observations)


def test_labels_are_the_datasets_words():
    draw = np.random.default_rng(0)
    names = ["move white mug down", "close drawer", "move white mug left", "turn faucet right"]
    for _ in range(20):
        sentence = hindsight.text(names, draw)
        assert sorted(phrases(sentence)) == sorted(names)
        assert sentence.count("mug") == 1, "one clause per mug"


def test_an_environment_without_thresholds_is_refused():
    kitchen = config.load("configs/kitchen.toml")
    with pytest.raises(UserError, match="sub_task"):
        hindsight.relabel(wander(kitchen, 20), kitchen, 20, 5, 1, seed=0)
