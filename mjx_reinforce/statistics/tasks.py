"""Statistics of runs on several tasks, whose seeds are resampled task by task.

As in rliable (Agarwal et al. 2021, arXiv:2108.13264), the runs of a task are drawn with replacement
from those of that task: a stratified bootstrap, to which the tasks themselves are fixed.
"""

from collections.abc import Callable, Sequence

import numpy as np

from mjx_reinforce.statistics import Estimate, enough, iqm

_RESAMPLES = 2000
#: Scores that are in memory at once.
_AT_ONCE = 2**21


def mean_of_tasks(scores: Sequence[np.ndarray]) -> Estimate:
    """Returns the mean of the tasks' means, with its 95% interval, see ``_estimate``."""
    return _estimate(lambda parts: np.mean([part.mean(axis=-1) for part in parts], axis=0), scores)


def iqm_of_tasks(scores: Sequence[np.ndarray]) -> Estimate:
    """Returns the interquartile mean of all runs of all tasks, with its 95% interval.

    A task with more seeds counts more; see ``_estimate``.
    """
    return _estimate(lambda parts: iqm(np.concatenate(parts, axis=-1)), scores)


def performance_profile(scores: Sequence[np.ndarray], thresholds: np.ndarray) -> Estimate:
    """Returns the share of runs above each threshold, the mean of the tasks' shares.

    Args:
      scores: [S] of each task.
      thresholds: [T] scores.

    Returns:
      Arrays [T], the interval pointwise.
    """

    def shares(parts: Sequence[np.ndarray]) -> np.ndarray:
        return np.mean(
            [(part[..., None, :] > thresholds[:, None]).mean(axis=-1) for part in parts], axis=0
        )

    return _estimate(shares, scores, size=len(thresholds))


def _estimate(
    statistic: Callable[[Sequence[np.ndarray]], np.ndarray],
    scores: Sequence[np.ndarray],
    size: int = 1,
) -> Estimate:
    """Returns a statistic with its percentile interval of a stratified bootstrap at 95%.

    Args:
      statistic: of scores [..., S] of each task.
      scores: [S] of each task.
      size: numbers that the statistic makes of each score.

    Returns:
      The ends are NaN if a task has fewer than six seeds.
    """
    estimate = statistic(scores)
    if not all(enough(len(part)) for part in scores):
        return Estimate(estimate, np.full_like(estimate, np.nan), np.full_like(estimate, np.nan))
    random = np.random.default_rng(0)
    block_size = max(1, _AT_ONCE // (size * sum(map(len, scores))))
    resamples = []
    for start in range(0, _RESAMPLES, block_size):
        num_draws = min(block_size, _RESAMPLES - start)
        draws = [part[random.integers(0, len(part), (num_draws, len(part)))] for part in scores]
        resamples.append(statistic(draws))
    low, high = np.quantile(np.concatenate(resamples), [0.025, 0.975], axis=0)
    return Estimate(estimate, low, high)
