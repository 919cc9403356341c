"""Statistics of one configuration against hand counts, scipy and rliable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import library, metrics
from scipy import stats

from mjx_reinforce.statistics import aggregates, bootstrap
from mjx_reinforce.statistics.aggregates import (
    cvar,
    interval,
    median_interval,
    performance_profile,
    wilson,
)

NAMES = ("mean", "median", "iqm", "cvar")
RLIABLE = {
    "mean": metrics.aggregate_mean,
    "median": metrics.aggregate_median,
    "iqm": metrics.aggregate_iqm,
}


def scores(num_runs=10, num_tasks=6):
    """Scores as rliable has them, [runs, tasks], and as we have them: in a row, with their task."""
    table = np.random.default_rng(1).exponential(size=(num_runs, num_tasks)) * np.arange(1, 7) / 3
    return table, table.ravel(), np.tile(np.arange(num_tasks), num_runs)


@pytest.mark.parametrize("name", RLIABLE)
def test_values_are_those_of_rliable(name):
    table, values, tasks = scores()
    expected = RLIABLE[name](table)
    assert interval(name, values, strata=tasks).value == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", RLIABLE)
def test_resamples_are_those_of_rliable(name):
    """The same percentiles but for the luck of the draws: 5000 here, 5000 there.

    Each end's standard error is 0.038 standard deviations of the resamples, if these are normal.
    """
    table, values, tasks = scores()
    np.random.seed(0)  # rliable draws from there
    library_ends = library.get_interval_estimates(
        {"": table}, lambda x: np.array([RLIABLE[name](x)]), reps=5000
    )[1][""].ravel()
    resampled = aggregates.resampled(name, values, tasks)
    ends = bootstrap.percentiles(resampled, 0.025)
    assert np.max(np.abs(ends - library_ends)) < 4 * np.sqrt(2) * 0.038 * resampled.std()


def test_strata_are_resampled_apart():
    """Nothing varies within the tasks, so nothing varies between the resamples."""
    resampled = aggregates.resampled("iqm", np.tile([1.0, 5.0], 3), np.tile([0, 1], 3))
    assert np.all(resampled == 3.0)
    found = interval("mean", np.arange(12.0).reshape(2, 6), strata=[0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(found.value, [2.5, 8.5])


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


@pytest.mark.parametrize("num_seeds", [6, 9, 20, 51, 1000])
def test_median_interval_is_within_that_of_scipy(num_seeds):
    """SciPy's order statistics cover with the level or more, the next ones with less."""
    values = np.arange(num_seeds) + 0.0
    exact = stats.quantile_test(values).confidence_interval(0.95)
    low, high = median_interval(values)
    assert exact.low <= low <= exact.low + 1
    assert exact.high - 1 <= high <= exact.high


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
    assert interval("median", values).value == 28.5
    assert np.all(np.isfinite(interval("iqm", values)))
    values[:] = failed
    assert all(np.all(np.isnan(interval(name, values))) for name in NAMES)


def test_an_unknown_statistic_is_named():
    with pytest.raises(ValueError, match="'mode' is unknown; choose one of mean, median"):
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
