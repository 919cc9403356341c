"""The test that decides how many seeds a sweep needs: its looks, its error, its arithmetic."""

import itertools

import numpy as np
import pytest

from experiments.checks.until_decided import row
from mjx_reinforce.statistics import sequential
from mjx_reinforce.statistics.sequential import look_seeds, sequential_test


def test_looks_are_even_parts_of_the_budget():
    assert look_seeds(64) == [8, 16, 24, 32, 40, 48, 56, 64]
    assert look_seeds(6) == [1, 2, 3, 4, 5, 6]
    assert look_seeds(100)[-1] == 100


def test_as_all_choices_of_signs(monkeypatch):
    """Of few seeds all choices can be listed: p of one look is the share that is as extreme."""
    monkeypatch.setattr(sequential, "_LOOKS", 1)
    values = np.random.default_rng(3).normal(size=(300, 2, 10))
    values[:, 1] += 0.8
    signs = np.array([*itertools.product([-1, 1], repeat=10)])
    sums = np.abs((values[:, 1] - values[:, 0]) @ signs.T)
    p_values = np.mean(sums >= sums[:, -1:] * (1 - 1e-9), axis=1)
    # Beside the level, 8192 random choices may say either.
    sure = np.abs(p_values - 0.05) > 0.01
    apart = np.array([len(sequential_test([*pair], 10).contenders) == 1 for pair in values])
    assert 30 < apart.sum() < 270
    np.testing.assert_array_equal(apart[sure], p_values[sure] < 0.05)


def test_verdict_is_that_of_each_look_so_far():
    """What a look said does not change as seeds come in: a sweep goes on from its files."""
    values = np.random.default_rng(0).normal(size=(3, 64)) + np.array([[0.0], [2.0], [2.5]])
    whole = sequential_test([*values], 64)
    for count, end in enumerate(whole.looks, start=1):
        part = sequential_test([*values[:, :end]], 64)
        assert part.looks == whole.looks[:count]
        assert set(part.contenders) >= set(whole.contenders)
    assert part == whole


def test_excluded_configuration_needs_no_more_seeds():
    values = np.random.default_rng(0).normal(size=(3, 64)) + np.array([[0.0], [5.0], [5.1]])
    verdict = sequential_test([*values], 64)
    used = [x[:n] for x, n in zip(values, verdict.num_seeds, strict=True)]
    assert verdict.num_seeds[0] < verdict.num_seeds[1]
    assert sequential_test(used, 64) == verdict


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_unit_does_not_matter(scale):
    values = np.random.default_rng(1).normal(size=(2, 64)) + np.array([[0.0], [0.6]])
    assert sequential_test([*(scale * values)], 64) == sequential_test([*values], 64)


def test_equal_returns_stay_undecided():
    verdict = sequential_test([np.full(64, 500.0)] * 3, 64)
    assert (verdict.contenders, verdict.looks[-1], verdict.is_over) == ([0, 1, 2], 64, True)


def test_failed_seeds_are_the_worst():
    good = np.linspace(1.0, 2.0, 64)
    failed = np.where(np.arange(64) % 2, np.nan, good)
    assert sequential_test([failed, good], 64).contenders == [1]
    assert sequential_test([np.full(64, np.nan)] * 2, 64).contenders == [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("returns", ["normal", "two peaks"])
def test_errs_as_rarely_as_it_says(returns):
    """A small version of experiments/checks/until_decided.py, whose table is in the docs."""
    figures = row(returns, (1.0, 1.0), 0.0, sweeps=400)
    # Three standard errors above 5%.
    assert figures["wrong"] < 5 + 3 * 100 * (0.05 * 0.95 / 400) ** 0.5
    figures = row(returns, (1.0, 1.0), 1.0, sweeps=100)
    assert figures["decided"] > 95
    assert figures["seeds"] < 32
