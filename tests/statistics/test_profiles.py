"""Performance profiles against rliable and scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rliable import library
from scipy import stats

from mjx_reinforce.statistics.aggregates import performance_profile


def test_profile_is_that_of_rliable():
    values = np.round(np.random.default_rng(1).normal(size=50), 1)
    thresholds = np.linspace(-3, 3, 61).round(1)  # many of them are values
    expected = library.score_distributions(values[:, None], thresholds)
    np.testing.assert_array_equal(performance_profile(values, thresholds).value, expected)


def test_band_is_wilsons():
    share, low, high = performance_profile([1.0, 2.0, 3.0, 4.0], [0.0, 2.0, 9.0])
    np.testing.assert_array_equal(share, [1.0, 0.5, 0.0])
    ends = [stats.binomtest(k, 4).proportion_ci(method="wilson") for k in (4, 2, 0)]
    np.testing.assert_allclose(np.stack([low, high], axis=1), ends, atol=1e-14)


def test_a_failed_seed_is_above_nothing():
    values = np.array([np.nan, np.inf, -np.inf, 5.0])
    np.testing.assert_array_equal(performance_profile(values, [-1e300, 5.0]).value, [0.25, 0.0])


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=10))
def test_profiles_fall(values):
    thresholds = np.linspace(-11, 11, 23)
    for line in performance_profile(values, thresholds):
        assert np.all(np.diff(line) <= 1e-12)
    share, low, high = performance_profile(values, thresholds)
    assert np.all((low <= share) & (share <= high))


@pytest.mark.parametrize("confidence", [0.5, 0.99])
def test_the_band_has_the_level_that_is_asked_for(confidence):
    band = performance_profile([1.0, 2.0, 3.0, 4.0], [2.5], confidence)
    expected = stats.binomtest(2, 4).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose([band.low[0], band.high[0]], expected, atol=1e-14)
