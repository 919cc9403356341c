"""Statistics over seeds against hand counts and known coverage."""

import warnings

import numpy as np
import pytest

from mjx_reinforce.reports.statistics import iqm, iqm_interval, steps_to_solve


def test_iqm_is_the_mean_of_the_middle_half():
    assert iqm(np.array([1000.0, 3.0, 1.0, 2.0, -50.0, 4.0, 5.0, 6.0])) == pytest.approx(3.5)


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


def test_interval_is_the_percentile_bootstrap():
    """5000 resamples of as many seeds, drawn from the generator of seed 0; at 95 %."""
    values = np.random.default_rng(3).exponential(size=40)
    drawn = np.random.default_rng(0).integers(0, 40, (5000, 40))
    expected = np.quantile(iqm(values[drawn]), [0.025, 0.975])
    np.testing.assert_allclose(iqm_interval(values), expected, rtol=1e-12)
    expected = np.quantile(iqm(values[drawn]), [0.25, 0.75])
    np.testing.assert_allclose(iqm_interval(values, confidence=0.5), expected, rtol=1e-12)


def test_interval_of_two_seeds():
    """Their mean is 0 in a quarter of the resamples, a half in two quarters, 1 in one."""
    values = np.array([[0.0, 1.0], [0.0, 2.0], [10.0, 11.0]])
    for low, high in (iqm_interval(values), iqm_interval(values.T, axis=0)):
        np.testing.assert_allclose(low, [0.0, 0.0, 10.0])
        np.testing.assert_allclose(high, [1.0, 2.0, 11.0])
    low, high = iqm_interval(values, confidence=0.4)
    np.testing.assert_allclose(low, [0.5, 1.0, 10.5])
    np.testing.assert_allclose(high, [0.5, 1.0, 10.5])


def test_interval_covers_the_truth_as_often_as_it_says():
    random = np.random.default_rng(1)
    samples = random.normal(size=(300, 40))
    low, high = iqm_interval(samples)
    assert 0.90 <= np.mean((low <= 0) & (high >= 0)) <= 0.985


def test_equal_seeds_have_an_interval_of_no_width():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert iqm_interval(np.full(5, 1000.0)) == (1000.0, 1000.0)
        low, high = iqm_interval(np.array([[7, 7], [0, 2]]))
    np.testing.assert_allclose([low, high], [[7.0, 0.0], [7.0, 2.0]])


def test_one_seed_has_no_interval():
    low, high = iqm_interval(np.array([3.0]))
    assert np.isnan(low)
    assert np.isnan(high)
    for ends in (iqm_interval(np.ones((4, 1))), iqm_interval(np.ones((1, 4)), axis=0)):
        for end in ends:
            assert end.shape == (4,)
            assert np.all(np.isnan(end))


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
