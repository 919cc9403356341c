"""How many seeds a question needs, against formulas for normal values."""

import numpy as np
import pytest
from scipy import stats

from mjx_reinforce.statistics.comparisons import seeds_needed, wrong_winner

NORMAL = stats.norm.ppf((np.arange(2000) + 0.5) / 2000)


@pytest.mark.parametrize(("effect", "expected"), [(1.0, 17), (-0.5, 64), (0.3, 176)])
def test_seeds_needed_are_those_of_the_t_test(effect, expected):
    """Cohen (1988), table 2.4: 17, 64 and 175 of each for a power of 80 % at 5 %.

    Power is estimated from 2000 draws, so it is 0.009 off, and the seeds are by 2.3 %.
    """
    found = seeds_needed(NORMAL + effect, NORMAL)
    assert found == pytest.approx(expected, rel=0.07, abs=1)


def test_more_power_and_a_stricter_level_need_more():
    """Normal approximations: 16, 26 and 35, and a few more for variances that are not known."""
    assert seeds_needed(NORMAL + 1, NORMAL) in range(16, 19)
    assert seeds_needed(NORMAL + 1, NORMAL, power=0.95) in range(26, 30)
    assert seeds_needed(NORMAL + 1, NORMAL, alpha=0.001) in range(35, 42)


def test_small_effects_need_many_seeds_or_too_many():
    expected = 2 * (stats.norm.ppf(0.975) + stats.norm.ppf(0.8)) ** 2 / 0.05**2
    assert seeds_needed(NORMAL + 0.05, NORMAL) == pytest.approx(expected, rel=0.01)
    assert seeds_needed(NORMAL + 0.03, NORMAL) is None
    assert seeds_needed(NORMAL, NORMAL) is None


def test_failed_seeds_are_the_worst():
    x, y = np.full(100, 10.0), np.full(100, 10.0)
    y[:50] = np.nan
    y[50:60] = 0.0
    with_zeros = np.where(np.isfinite(y), y, 0.0)
    assert seeds_needed(x, y) == seeds_needed(x, with_zeros)
    assert wrong_winner(x, y, 3) == wrong_winner(x, with_zeros, 3)


@pytest.mark.parametrize("num_seeds", [1, 3, 10])
def test_wrong_winner_of_normal_values(num_seeds):
    expected = stats.norm.cdf(-0.5 * np.sqrt(num_seeds / 2))
    error = float(np.sqrt(expected * (1 - expected) / 10_000))
    for sign in (1, -1):
        found = wrong_winner(NORMAL + 0.5 * sign, NORMAL, num_seeds)
        assert found == pytest.approx(expected, abs=4 * error)


def test_a_draw_without_a_winner_counts_half():
    """One seed of each: the better one wins half of the time, else both have 0."""
    found = wrong_winner(np.array([0.0, 1.0]), np.array([0.0, 0.0]), 1)
    assert found == pytest.approx(0.25, abs=0.02)
    assert np.isnan(wrong_winner(np.ones(3), np.ones(3), 1))


def test_the_winner_is_that_of_the_statistic():
    """The mean of x is lower, its median higher."""
    x, y = np.array([-100.0, 1.0, 1.0, 1.0, 1.0]), np.zeros(5)
    assert wrong_winner(x, y, 200) < 0.01
    assert wrong_winner(x, y, 200, statistic="median") < 0.01
    assert wrong_winner(x, y, 3) > 0.45
    assert wrong_winner(x, y, 3, statistic="median") < 0.15
