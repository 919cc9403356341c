"""Bounds of a share of all runs: Wilks' numbers of seeds, and how often the bounds hold."""

import numpy as np
import pytest
from scipy import stats

from mjx_reinforce.statistics.tolerance import lower_tolerance, tolerance_seeds


@pytest.mark.parametrize(("share", "seeds"), [(0.9, 29), (0.95, 59), (0.99, 299)])
def test_seeds_as_published(share, seeds):
    """Wilks 1941; NIST/SEMATECH e-Handbook of Statistical Methods, 7.2.6.3."""
    assert tolerance_seeds(share) == seeds
    values = np.arange(seeds, dtype=float)
    assert lower_tolerance(values, share) == 0
    assert np.isnan(lower_tolerance(values[1:], share))


@pytest.mark.parametrize("num_seeds", [29, 64, 300])
def test_bound_holds_as_often_as_it_says(num_seeds):
    draws = np.random.default_rng(0).random((4000, num_seeds))
    bounds = np.array([lower_tolerance(draw) for draw in draws])
    # Of uniform returns, the share at or above a bound is 1 less the bound.
    held = np.mean(1 - bounds >= 0.9)
    rank = np.flatnonzero(np.sort(draws[0]) == bounds[0])[0] + 1
    assert held == pytest.approx(stats.binom.sf(rank - 1, num_seeds, 0.1), abs=0.015)
    assert held > 0.94


def test_failed_seeds_are_the_lowest():
    values = np.where(np.arange(64) < 2, np.nan, 10.0 + np.arange(64))
    assert lower_tolerance(values) == 12
    assert np.isnan(lower_tolerance(np.where(np.arange(64) < 3, np.nan, values)))
