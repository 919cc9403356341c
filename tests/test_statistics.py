"""Statistics over seeds against hand counts and known coverage."""

import numpy as np
import pytest

from mjx_reinforce.reports.statistics import iqm, iqm_interval, steps_to_solve


def test_iqm_is_the_mean_of_the_middle_half():
    assert iqm(np.array([1000.0, 3.0, 1.0, 2.0, -50.0, 4.0, 5.0, 6.0])) == pytest.approx(3.5)


def test_interval_covers_the_truth_as_often_as_it_says():
    random = np.random.default_rng(1)
    samples = random.normal(size=(300, 40))
    low, high = iqm_interval(samples)
    assert 0.90 <= np.mean((low <= 0) & (high >= 0)) <= 0.985


def test_equal_seeds_have_an_interval_of_no_width():
    assert iqm_interval(np.full(5, 1000.0)) == (1000.0, 1000.0)
    assert np.all(np.isnan(iqm_interval(np.array([3.0]))))


def test_steps_to_solve_is_the_first_time():
    returns = np.array([[0.0, 0.0, 9.0], [10.0, 2.0, 11.0], [3.0, 4.0, 12.0]])
    steps = np.array([[0, 0, 0], [50, 60, 70], [100, 120, 140]])
    assert steps_to_solve(returns, steps, 10.0) == [50, None, 70]
    assert steps_to_solve(returns, steps, None) == [None, None, None]
