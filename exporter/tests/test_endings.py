"""Tests other endings: which texts are made, and which steps count."""

import dataclasses

import pytest
import torch

from lads_exporter import config
from lads_exporter.endings import JOIN, Endings, texts


@pytest.fixture(scope="module")
def kitchen():
    return config.load("configs/kitchen.toml")


def test_endings_keep_the_beginning_and_make_no_real_instruction(kitchen):
    real = {row["text"] for row in kitchen.instructions}
    assert len(real) == 25
    made = texts(kitchen.instructions, 40)
    assert set(made) == {(index, kept) for index in range(22) for kept in (1, 2, 3)}
    for (index, kept), group in made.items():
        original = kitchen.instructions[index]["text"].split(JOIN)
        assert group and not real & set(group)
        for text in group:
            phrases = text.split(JOIN)
            assert phrases[:kept] == original[:kept] and phrases != original
            assert len(phrases) == len(set(phrases)) == 4
    assert made == texts(kitchen.instructions, 40), "the same texts every time"


def test_the_order_of_the_splits_does_not_matter(kitchen):
    """Tests that an index is one of all instructions, wherever the seen ones stand in the file."""
    unseen_first = sorted(kitchen.instructions, key=lambda row: row["split"] == "seen")
    made = texts(unseen_first, 5)
    assert {index for index, _ in made} == {index for index, row in enumerate(unseen_first) if row["split"] == "seen"}
    for (index, kept), group in made.items():
        beginning = unseen_first[index]["text"].split(JOIN)[:kept]
        assert all(text.split(JOIN)[:kept] == beginning for text in group)


def test_only_steps_before_the_ending_count(kitchen):
    parts = kitchen.config
    data = dataclasses.replace(parts.data, ending_rate=0.5, ending_variants=5, ending_margin=0.6)
    language = dataclasses.replace(parts.language, encoder="random-8")
    setting = dataclasses.replace(kitchen, config=dataclasses.replace(parts, data=data, language=language))
    endings = Endings(setting, torch.device("cpu"))
    torch.manual_seed(0)
    found = [draw for draw in (endings.draw(3, 200) for _ in range(400)) if draw is not None]
    assert 150 < len(found) < 250
    assert {steps for _, steps in found} == {20, 70, 120}
    assert all(words.shape[1] == 8 for words, _ in found)


def test_no_endings_by_default():
    endings = Endings(config.load("configs/kitchen-paper.toml"), torch.device("cpu"))
    assert all(endings.draw(0, 200) is None for _ in range(50))
