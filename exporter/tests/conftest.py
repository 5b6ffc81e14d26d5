"""Shared fixtures: small policies with random weights, through the real code."""

import pytest
import torch

from lads_exporter import config, language, random_policy

torch.set_num_threads(1)


def make_policy(name, seed=0):
    setting = config.load(f"configs/{name}.toml")
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    lads, model = random_policy.export(setting, encoded, seed)
    return setting, encoded, lads.eval(), model


@pytest.fixture(scope="session", params=["tiny", "kitchen", "lorel"])
def policy(request):
    """Makes a policy with random weights -> (setting, encoded, lads, model)."""
    return make_policy(request.param)


@pytest.fixture(scope="session")
def tiny():
    return make_policy("tiny")
