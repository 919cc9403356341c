"""Statistics of one configuration against hand counts, scipy and rliable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import metrics
from scipy import stats

from mjx_reinforce.statistics import iqm, iqm_interval
from mjx_reinforce.statistics.aggregates import cvar, estimate_mean, wilson


def test_values_are_those_of_rliable():
    table = np.random.default_rng(1).exponential(size=(10, 6)) * np.arange(1, 7) / 3
    values = table.ravel()
    assert estimate_mean(values).value == pytest.approx(metrics.aggregate_mean(table), rel=1e-12)
    assert iqm(values) == pytest.approx(metrics.aggregate_iqm(table), rel=1e-12)


def test_cvar_by_hand():
    values = np.arange(20.0, 0.0, -1.0)
    assert cvar(values) == pytest.approx(1.5)
    assert cvar(values, 0.125) == pytest.approx((1 + 2 + 0.5 * 3) / 2.5)
    assert cvar(values[:3]) == 18.0  # a tenth of three is a part of the worst
    assert cvar(values, 1.0) == pytest.approx(10.5)


@pytest.mark.parametrize("trials", [1, 7, 40])
def test_wilson_is_that_of_scipy(trials):
    counts = np.arange(trials + 1)
    found = wilson(counts, trials)
    expected = [stats.binomtest(k, trials).proportion_ci(method="wilson") for k in counts]
    np.testing.assert_allclose(found.value, counts / trials)
    np.testing.assert_allclose(np.stack(found[1:], axis=1), expected, atol=1e-14)


@pytest.mark.parametrize("failed", [np.nan, np.inf, -np.inf])
def test_a_failed_seed_is_the_worst(failed):
    values = np.arange(60.0)
    values[-1] = failed
    assert np.isnan(estimate_mean(values)).tolist() == [True, True, False]
    assert np.isnan(cvar(values))
    assert np.all(np.isfinite(iqm_interval(values)))
    values[:] = failed
    assert np.all(np.isnan([*estimate_mean(values), *iqm_interval(values), cvar(values)]))


RETURNS = st.lists(st.floats(-1000, 1000), min_size=2, max_size=12)


@settings(max_examples=25, deadline=None)
@given(RETURNS, st.integers(0, 11), st.floats(0, 1000))
def test_a_better_seed_makes_nothing_worse(values, place, more):
    before = np.array(values)
    after = before.copy()
    after[place % len(before)] += more
    found = [[*estimate_mean(x), iqm(x), *iqm_interval(x), cvar(x)] for x in (before, after)]
    for old, new in zip(*found, strict=True):
        assert np.isnan(old) or new >= old - 1e-9


@pytest.mark.parametrize("confidence", [0.5, 0.99])
def test_the_band_has_the_level_that_is_asked_for(confidence):
    band = wilson(2, 4, confidence)
    expected = stats.binomtest(2, 4).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose([band.low, band.high], expected, atol=1e-14)
