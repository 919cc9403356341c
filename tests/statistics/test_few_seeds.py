"""What too few seeds, or seeds that are all alike, cannot say: no interval, and no small p."""

import numpy as np
import pytest

from mjx_reinforce.statistics import iqm_interval, mean_interval
from mjx_reinforce.statistics.comparisons import (
    compare_all,
    paired_difference,
    probability_of_improvement,
    seeds_needed,
)
from mjx_reinforce.statistics.survival import log_rank, median_steps, restricted_mean

INTERVALS = {"mean": mean_interval, "iqm": iqm_interval}
MOST = "mean iqm"


@pytest.mark.parametrize(
    ("values", "bounded"),
    [
        ([3.0], ""),
        ([3.0, 5.0], ""),
        ([3.0, 5.0, 9.0], ""),
        (np.arange(5.0), ""),
        (np.arange(6.0), MOST),
        (np.arange(60.0), MOST),
        (np.full(5, 7.0), ""),
        (np.full(6, 7.0), ""),
        (np.full(10, 7.0), ""),
        (np.full(11, 7.0), "iqm"),
        (np.full(60, 7.0), "iqm"),
        (0.1 + 1e-9 * np.arange(9), ""),  # float32 numbers are not as exact
        ([np.nan, 3.0], ""),
        ([np.nan] * 60, ""),
        ([-np.inf, *range(59)], "iqm"),
        ([np.inf] * 30 + [5.0] * 30, ""),
    ],
)
def test_an_interval_is_of_seeds_that_can_bear_it(values, bounded):
    for name, interval in INTERVALS.items():
        found = interval(np.asarray(values))
        assert np.all(np.isfinite(found)) == (name in bounded.split()), name


@pytest.mark.parametrize(
    ("first", "second", "p_value", "bounded"),
    [
        ([3.0], [1.0], 1.0, False),
        ([3.0, 4.0], [1.0, 2.0], 0.5, False),
        ([3.0, 4.0, 5.0], [1.0, 2.0, 2.999], 0.25, False),
        (np.arange(5.0) + 2, np.arange(5.0), 2**-4, False),
        (np.arange(6.0) + 2, np.arange(6.0), 2**-5, False),
        (np.arange(6.0) + 0.1, np.arange(6.0), 2**-5, False),  # equal but for rounding
        (np.array([9.0, 9, 9, 9, 9, 8]), np.zeros(6), 2**-5, True),
        (np.arange(99.0), np.arange(99.0), 1.0, False),
        (np.eye(99)[0] + np.eye(99)[1], np.zeros(99), 0.5, True),  # two can be told apart
        ([np.nan] * 3, [1.0, 2.0, 3.0], 0.5, False),
        ([np.inf] * 9, [np.nan] * 9, 1.0, False),
    ],
)
def test_no_p_is_less_than_the_pairs_that_differ_allow(first, second, p_value, bounded):
    found = paired_difference(first, second)
    assert found.p_value == pytest.approx(p_value, rel=1e-12)
    assert np.isfinite(found.low) == np.isfinite(found.high) == bounded
    (pair,) = compare_all([np.asarray(first), np.asarray(second)])
    assert pair.adjusted == pytest.approx(p_value, rel=1e-12)
    _, low, high = probability_of_improvement(first, second, paired=True)
    assert high - low > 0.02


@pytest.mark.parametrize(("seeds", "least"), [(1, 1.0), (2, 2 / 6), (3, 0.1), (4, 2 / 70)])
def test_no_p_of_times_is_less_than_their_orders_allow(seeds, least):
    soon, late, all_of_them = np.arange(1, seeds + 1), np.arange(seeds) + 1000, np.ones(seeds)
    test = log_rank(soon, all_of_them, late, all_of_them)
    assert test.p_value == pytest.approx(max(least, 0.01), abs=0.02)
    assert test.p_value >= least - 1e-12


@pytest.mark.parametrize(
    ("steps", "mean", "median"),
    [
        ([10], False, False),
        (np.arange(5), False, False),
        (np.arange(9), True, True),
        (np.full(9, 10), False, True),
    ],
)
def test_times_of_few_seeds_have_no_interval(steps, mean, median):
    done = np.ones(len(steps), bool)
    assert np.isfinite(restricted_mean(steps, done, 50).low) == mean
    assert np.isfinite(median_steps(steps, done).low) == median
    assert np.isnan(restricted_mean(steps, ~done, max(steps)).low) if max(steps) else True


def test_two_constants_need_as_many_seeds_as_have_orders_enough():
    assert seeds_needed(np.full(9, 2.0), np.full(9, 1.0)) == 4
    assert seeds_needed(np.full(9, 2.0), np.full(9, 1.0), alpha=0.001) == 7


def test_seeds_that_show_one_group_of_two_miss_the_mean():
    """Three in ten are of a group far apart: six seeds show none of it in 0.7^6 of the draws."""
    random = np.random.default_rng(3)
    other = random.random((4000, 6)) < 0.3
    values = np.where(other, 100.0, 1000.0) + random.random(other.shape)
    low, high = mean_interval(values)
    covered, count = (low < 730.5) & (high > 730.5), other.sum(axis=1)
    assert not covered[count == 0].any()
    assert covered[(count > 0) & (count < 5)].all()
    assert np.mean(count == 0) == pytest.approx(0.7**6, abs=0.02)
