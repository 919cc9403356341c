"""Statistics over seeds against hand counts and known coverage."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import metrics
from scipy import stats

from mjx_reinforce.reports import findings
from mjx_reinforce.statistics import (
    bootstrap,
    cvar,
    estimate_mean,
    iqm,
    iqm_interval,
    mean_interval,
    steps_to_solve,
    summarize,
    wilson,
)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1.0, 2.0, 9.0], 4.0),  # fewer than four are averaged whole
        ([1.0, 2.0, 4.0, 99.0], 3.0),
        ([1.0, 2.0, 4.0, 6.0, 99.0], 4.0),  # a quarter of five is one
        ([0.0, 1.0, 2.0, 4.0, 5.0, 7.0, 99.0], 3.8),  # a quarter of seven too
    ],
)
def test_iqm_leaves_out_whole_values(values, expected):
    assert iqm(np.array(values)) == pytest.approx(expected)


def test_iqm_is_taken_along_its_axis():
    values = np.array([[1.0, 2.0, 4.0, 99.0], [0.0, 0.0, 8.0, 8.0]])
    np.testing.assert_allclose(iqm(values), [3.0, 4.0])
    np.testing.assert_allclose(iqm(values.T, axis=0), [3.0, 4.0])


def by_scipy(values, tail):
    """Percentiles of scipy's resamples of the seeds, sorted by their values at each point."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return stats.bootstrap(
            (np.sort(values),),
            iqm,
            axis=-1,
            n_resamples=5000,
            confidence_level=1 - 2 * tail,
            method="percentile",
            vectorized=True,
            rng=np.random.default_rng(0),
        ).confidence_interval


@pytest.mark.parametrize("confidence", [0.95, 0.5])
def test_interval_is_the_expanded_percentile_bootstrap(confidence):
    """Percentiles at the normal probability of Student's quantile."""
    values = np.random.default_rng(3).exponential(size=40)
    tail = stats.norm.cdf(stats.t.ppf((1 - confidence) / 2, 39))
    expected = by_scipy(values, tail)
    np.testing.assert_allclose(iqm_interval(values, confidence=confidence), expected, rtol=1e-12)


def test_interval_of_the_mean_is_the_expanded_percentile_bootstrap():
    """For ten seeds the normal quantile, times sqrt(9 / 10), is Student's, 2.262."""
    tail = bootstrap.expanded_tail(0.95, 9, np.sqrt(0.9))
    assert stats.norm.ppf(tail) * np.sqrt(0.9) == pytest.approx(-2.262, abs=5e-4)
    values = np.random.default_rng(3).exponential(size=10)
    drawn = np.random.default_rng(0).integers(0, 10, (5000, 10))
    expected = np.quantile(np.sort(values)[drawn].mean(axis=1), [tail, 1 - tail])
    np.testing.assert_allclose(mean_interval(values), expected, rtol=1e-12)


def test_interval_of_two_seeds():
    """Their mean is 0 in a quarter of the resamples, a half in two quarters, 1 in one."""
    values = np.array([[0.0, 1.0], [0.0, 2.0], [10.0, 11.0]])
    for ends in (iqm_interval(values, confidence=0.5), iqm_interval(values.T, 0, 0.5)):
        np.testing.assert_allclose(ends, [[0.0, 0.0, 10.0], [1.0, 2.0, 11.0]])
    low, high = iqm_interval(values, confidence=0.1)
    np.testing.assert_allclose(low, [0.5, 1.0, 10.5])
    np.testing.assert_allclose(high, [0.5, 1.0, 10.5])


def test_interval_covers_the_truth_as_often_as_it_says():
    random = np.random.default_rng(1)
    samples = random.normal(size=(300, 40))
    low, high = iqm_interval(samples)
    assert 0.90 <= np.mean((low <= 0) & (high >= 0)) <= 0.985


def test_steps_to_solve_is_the_first_time():
    returns = np.array([[0.0, 0.0, 9.0], [10.0, 2.0, 11.0], [3.0, 4.0, 12.0]])
    steps = np.array([[0, 0, 0], [50, 60, 70], [100, 120, 140]])
    assert steps_to_solve(returns, steps, 10.0) == [50, None, 70]
    assert steps_to_solve(returns, steps, None) == [None, None, None]
    assert steps_to_solve(returns[:2], steps[:2], 0.0) == [0, 0, 0]
    assert all(type(step) is int for step in steps_to_solve(returns, steps, 0.0))


def test_a_return_that_is_not_finite_solves_nothing():
    returns = np.array([[np.nan, np.nan], [5.0, np.nan]])
    assert steps_to_solve(returns, np.array([[0, 0], [9, 9]]), 5.0) == [9, None]


CURVES = {
    "smooth": lambda random, n: random.normal(size=(3, n)),
    "ties": lambda random, n: random.integers(0, 3, size=(3, n)),
    "solved": lambda random, n: np.minimum(random.normal(1001, 1, size=(2, n)), 1000.0),
    "outliers": lambda random, n: random.normal(size=(2, n)) * 10.0 ** random.integers(0, 9, n),
    "one for all": lambda random, n: np.repeat(random.normal(size=(2, 1)), n, axis=1),
}


@pytest.mark.parametrize("num_seeds", [2, 5, 222])
@pytest.mark.parametrize("kind", CURVES)
def test_resamples_are_those_of_scipy(kind, num_seeds):
    values = CURVES[kind](np.random.default_rng(num_seeds), num_seeds)
    found = bootstrap.percentiles(bootstrap.resampled_trim_means(values, 0.25), 0.025)
    np.testing.assert_allclose(found, by_scipy(values, 0.025), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("failed", [np.nan, np.inf, -np.inf])
def test_a_failed_seed_is_worse_than_every_other(failed):
    """Of eight, two are left out at each end."""
    values = np.array([-1000.0, -3.0, -1.0, -2.0, -50.0, -4.0, -5.0, -6.0])
    values[2] = failed
    assert iqm(values) == pytest.approx((-50 - 6 - 5 - 4) / 4)
    assert iqm(values.astype(np.float32)).dtype == np.float32
    values[3] = failed
    assert iqm(values) == pytest.approx((-1000 - 50 - 6 - 5) / 4)
    values[1] = failed
    assert np.isnan(iqm(values))
    assert np.isnan(iqm(np.array([1.0, 2.0, failed])))


@pytest.mark.parametrize("num_failed", [1, 10, 24, 26, 30, 60, 100])
def test_interval_of_failed_seeds(num_failed):
    """An end is NaN where resamples around it have no mean; the upper one goes last."""
    values = np.random.default_rng(5).normal(size=100)
    values[:num_failed] = np.nan
    ordered = np.sort(np.nan_to_num(values, nan=-np.inf))
    means = iqm(ordered[np.random.default_rng(0).integers(0, 100, (5000, 100))])
    tail = bootstrap.expanded_tail(0.95, 99)
    with np.errstate(invalid="ignore"):
        expected = np.quantile(np.nan_to_num(means, nan=-np.inf), [tail, 1 - tail])
    expected[~np.isfinite(expected)] = np.nan
    np.testing.assert_allclose(iqm_interval(values), expected, rtol=1e-12)
    assert np.isnan(expected).tolist() == [num_failed > 10, num_failed > 30]


def test_a_thousand_seeds_take_little_memory():
    """Two hundred points of them, in a process of its own, all libraries included."""
    code = (
        "import numpy\n"
        "from mjx_reinforce.statistics import iqm_interval\n"
        "iqm_interval(numpy.random.default_rng(0).normal(size=(200, 1000)))\n"
        # Not resource.getrusage: its maximum begins with that of the process which starts this one.
        "status = open('/proc/self/status').read()\n"
        "print(status.split('VmHWM:')[1].split()[0])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert float(done.stdout) < 500_000  # kB


def test_seeds_are_counted():
    returns = np.array([[5.0, 9.0, 1.0, np.nan], [9.0, 2.0, 3.0, 9.0], [9.0, 2.0, 4.0, np.nan]])
    counts = np.zeros((3, 4), int)
    summary = summarize({"eval_return": returns, "env_steps": counts, "episodes": counts}, 8.0)
    assert summary["seeds_solved_at_end"] == 1
    assert summary["seeds_ever_solved"] == 3
    assert summary["solve_rate"] == 0.25
    assert summary["seeds_nonfinite_at_end"] == 1
    assert summary["iqm"] == pytest.approx(3.0)  # of 2 and 4
    summary = summarize({"eval_return": returns, "env_steps": counts, "episodes": counts}, None)
    for name in ("seeds_solved_at_end", "seeds_ever_solved", "solve_rate"):
        assert summary[name] is None


def test_a_curve_counts_failed_seeds_and_holds_those_that_stand_still():
    """The mean of three seeds: one fails in its second evaluation, one stops after it."""
    steps = np.array([[0, 0, 0], [10, 10, 10], [20, 20, 10], [30, 20, 10]])
    returns = np.array([[0.0, 3, 6], [6, np.nan, 6], [12, 9, np.nan], [18, np.nan, np.nan]])
    grid = np.array([0.0, 5, 10, 15, 20, 30])
    curves = findings.on_grid(grid, steps, returns)
    np.testing.assert_allclose(iqm(curves), [3, np.nan, np.nan, np.nan, 9, 11])


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
