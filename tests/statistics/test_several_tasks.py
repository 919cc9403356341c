"""Statistics of several tasks against rliable, whose runs are as many on each task."""

import numpy as np
import pytest
from rliable import library, metrics

from mjx_reinforce.statistics.tasks import iqm_of_tasks, mean_of_tasks, performance_profile

SCORES = np.random.default_rng(4).normal([0.2, 0.6, 0.9], 0.3, (20, 3))


@pytest.mark.filterwarnings("ignore:random_state is deprecated:FutureWarning")
@pytest.mark.parametrize(
    ("estimate", "metric"),
    [(mean_of_tasks, metrics.aggregate_mean), (iqm_of_tasks, metrics.aggregate_iqm)],
)
def test_aggregates_are_those_of_rliable(estimate, metric):
    found = estimate([*SCORES.T])
    assert found.value == pytest.approx(metric(SCORES), rel=1e-12)
    _, ends = library.get_interval_estimates(
        {"all": SCORES},
        lambda scores: np.array([metric(scores)]),
        reps=2000,
        random_state=np.random.RandomState(0),
    )
    # Two bootstraps of 2000 resamples.
    np.testing.assert_allclose([found.low, found.high], ends["all"][:, 0], atol=0.012)


def test_profile_is_that_of_rliable():
    thresholds = np.linspace(-0.5, 1.5, 21)
    found = performance_profile([*SCORES.T], thresholds)
    profiles, _ = library.create_performance_profile({"all": SCORES}, thresholds, reps=10)
    np.testing.assert_allclose(found.value, profiles["all"], atol=1e-12)
    assert (found.low <= found.value).all()
    assert (found.value <= found.high).all()


def test_each_task_keeps_its_share_of_a_resample():
    """Tasks that never vary leave nothing to resample, however far apart they are."""
    found = mean_of_tasks([np.zeros(8), np.full(20, 10.0)])
    assert found == (5.0, 5.0, 5.0)
    assert np.isnan(mean_of_tasks([np.zeros(8), np.zeros(5)]).low)
