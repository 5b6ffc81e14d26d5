"""Tests standard normal numbers: the bits of the runtime's, AS 241 as another implementation has it, and the distribution."""

import math
import statistics
from pathlib import Path

import numpy as np
import pytest

from lads_exporter.normals import Normals, ln, quantile

TABLE = Path(__file__).parents[2] / "runtime/core/tests/normals.txt"


def rows(kind):
    """Reads the words of the table's rows of one kind."""
    lines = (line.split() for line in TABLE.read_text(encoding="utf-8").splitlines())
    return [words[1:] for words in lines if words[0] == kind]


def distance(sample):
    """Computes the largest distance between a sample's distribution and the normal one (Kolmogorov and Smirnov)."""
    sample = np.sort(sample.astype(np.float64))
    expected = np.array([math.erfc(-x / math.sqrt(2)) / 2 for x in sample])
    places = np.arange(len(sample) + 1) / len(sample)
    return max((expected - places[:-1]).max(), (places[1:] - expected).max())


def test_quantiles_have_the_bits_of_the_table_and_the_accuracy_of_the_paper():
    numbers, exact, bits = zip(*rows("quantile"), strict=True)
    assert len(numbers) > 200
    got = quantile(np.array([int(number) / 2**53 for number in numbers]))
    assert [f"{value:016x}" for value in got.view(np.uint64)] == list(bits)
    exact = np.array([int(value, 16) for value in exact], np.uint64).view(np.float64)
    assert np.abs((got - exact) / exact).max() < 1e-15


def test_draws_have_the_bits_of_the_table():
    draws = rows("draws")
    assert sum(len(row) - 1 for row in draws) > 200
    for seed, *bits in draws:
        got = Normals(int(seed)).draw(len(bits))
        assert [f"{value:08x}" for value in got.view(np.uint32)] == bits, seed


def test_quantiles_are_those_of_the_standard_library():
    """Tests against CPython's `inv_cdf`, which is AS 241 too, in C, with the logarithm of the C library."""
    draw = np.random.default_rng(0)
    u = np.concatenate([draw.random(2_000), 2.0 ** -draw.uniform(1, 53, 2_000)])
    # The multiples of 2^-53.
    u = np.floor(u * 2**52) / 2**52 + 2.0**-53
    expected = np.array([statistics.NormalDist().inv_cdf(value) for value in u])
    assert np.abs(quantile(u) / expected - 1).max() < 1e-15


def test_the_logarithm_is_exact_to_one_unit():
    x = 2.0 ** -np.random.default_rng(1).uniform(1, 53, 20_000)
    expected = np.array([math.log(value) for value in x])
    assert (np.abs(ln(x) - expected) <= 1.5 * np.spacing(np.abs(expected))).all()


def test_a_sample_is_standard_normal():
    sample = Normals(11).draw(200_000)
    for power, moment, variance in [(1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)]:
        # Five standard deviations of the estimate.
        assert abs((sample.astype(np.float64) ** power).mean() - moment) < 5 * math.sqrt(variance / len(sample))
    # Exceeded by one sample in a thousand that is normal.
    assert distance(sample) < 1.95 / math.sqrt(len(sample))


def test_a_draw_goes_on_where_the_last_one_ended():
    whole, parts = Normals(4), Normals(4)
    draws = whole.draw(3, 4)
    assert draws.dtype == np.float32
    assert (draws.ravel() == np.concatenate([parts.draw(5), parts.draw(0), parts.draw(7)])).all()
    assert (Normals(5).draw(3, 4) != draws).all()
    assert (Normals(np.uint64(4)).draw(3, 4) == draws).all()


@pytest.mark.parametrize("seed", [-1, 1 << 64])
def test_a_seed_beyond_64_bits_is_refused(seed):
    with pytest.raises(ValueError, match="a seed is a whole number"):
        Normals(seed)
