"""Statistics of one configuration against hand counts, scipy and rliable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import library, metrics
from scipy import stats

from mjx_reinforce.statistics import aggregates
from mjx_reinforce.statistics.aggregates import (
    cvar,
    interval,
    performance_profile,
    wilson,
)

NAMES = ("mean", "iqm", "cvar")
RLIABLE = {"mean": metrics.aggregate_mean, "iqm": metrics.aggregate_iqm}


@pytest.mark.parametrize("name", RLIABLE)
def test_values_are_those_of_rliable(name):
    table = np.random.default_rng(1).exponential(size=(10, 6)) * np.arange(1, 7) / 3
    expected = RLIABLE[name](table)
    assert interval(name, table.ravel()).value == pytest.approx(expected, rel=1e-12)


def test_cvar_by_hand():
    values = np.arange(20.0, 0.0, -1.0)
    assert cvar(values) == pytest.approx(1.5)
    assert cvar(values, 0.125) == pytest.approx((1 + 2 + 0.5 * 3) / 2.5)
    assert cvar(values[:3]) == 18.0  # a tenth of three is a part of the worst
    assert cvar(values, 1.0) == pytest.approx(10.5)


def test_bootstrap_t_by_hand():
    """Every resample on its own: the mean of the worst fifth, and its standard error."""
    values = np.sort(np.random.default_rng(2).exponential(size=30))

    def value_and_error(sample):
        worst, quantile = np.sort(sample)[:6], np.sort(sample)[5]
        influence = quantile + np.minimum(sample - quantile, 0) / 0.2
        return worst.mean(), influence.std() / np.sqrt(30)

    value, error = value_and_error(values)
    drawn = np.random.default_rng(0).integers(0, 30, (5000, 30))
    t = [
        (v - value) / e if e else np.copysign(np.inf, v - value)
        for v, e in map(value_and_error, values[drawn])
    ]
    low, high = np.quantile(t, [0.025, 0.975], method="closest_observation")
    found = aggregates.cvar_interval(values, 0.2)
    np.testing.assert_allclose(found, [value - high * error, value - low * error], rtol=1e-9)


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
    assert np.isnan(interval("mean", values)).tolist() == [True, True, False]
    assert np.all(np.isnan(interval("cvar", values)))
    assert np.all(np.isfinite(interval("iqm", values)))
    values[:] = failed
    assert all(np.all(np.isnan(interval(name, values))) for name in NAMES)


def test_an_unknown_statistic_is_named():
    with pytest.raises(ValueError, match="'mode' is unknown; choose one of mean, iqm"):
        interval("mode", np.arange(5.0))


RETURNS = st.lists(st.floats(-1000, 1000), min_size=2, max_size=12)


@settings(max_examples=25, deadline=None)
@given(RETURNS, st.integers(0, 11), st.floats(0, 1000), st.sampled_from(NAMES))
def test_a_better_seed_makes_nothing_worse(values, place, more, name):
    before = np.array(values)
    after = before.copy()
    after[place % len(before)] += more
    for old, new in zip(interval(name, before), interval(name, after), strict=True):
        assert np.isnan(old) or new >= old - 1e-9


def test_profile_is_that_of_rliable():
    values = np.round(np.random.default_rng(1).normal(size=50), 1)
    thresholds = np.linspace(-3, 3, 61).round(1)  # many of them are values
    expected = library.score_distributions(values[:, None], thresholds)
    np.testing.assert_array_equal(performance_profile(values, thresholds).value, expected)


def test_a_failed_seed_is_above_nothing():
    values = np.array([np.nan, np.inf, -np.inf, 5.0])
    np.testing.assert_array_equal(performance_profile(values, [-1e300, 5.0]).value, [0.25, 0.0])


@pytest.mark.parametrize("confidence", [0.5, 0.99])
def test_the_band_has_the_level_that_is_asked_for(confidence):
    band = performance_profile([1.0, 2.0, 3.0, 4.0], [2.5], confidence)
    expected = stats.binomtest(2, 4).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose([band.low[0], band.high[0]], expected, atol=1e-14)
