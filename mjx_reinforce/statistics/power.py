"""How many seeds a question needs, learned from an experiment that had very many."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from mjx_reinforce.statistics import iqm
from mjx_reinforce.statistics.comparisons import failures_as_worst, least_p

_EXPERIMENTS = 2000
#: Up to so many seeds tests are drawn; beyond, means are as good as normal.
_DRAWN_SEEDS = 500
_MOST_SEEDS = 10_000


def seeds_needed(
    x: ArrayLike, y: ArrayLike, *, power: float = 0.8, alpha: float = 0.05
) -> int | None:
    """Returns how many seeds each of two configurations needs to be told apart.

    It is the least number at which Welch's t-test of so many seeds, drawn with replacement from x
    and from y, names the better one at the level ``alpha`` with the probability ``power``; four
    at 5 %, or more, for of fewer no order is rare enough.

    Args:
      x: [S] values of one configuration, of many seeds; a seed that failed counts as the worst
        finite value of both.
      y: [S'] values of another.
      power: how often the test is to find the difference.
      alpha: the level of the two-sided test.

    Returns:
      None if 10,000 seeds are not enough, or the two have the same mean.
    """
    x, y = failures_as_worst(x, y)
    if np.mean(x) == np.mean(y):
        return None
    enough = np.flatnonzero(_power_by_seeds(x, y, alpha) >= power)
    if len(enough):
        return int(enough[0]) + 2
    needed = _by_normal_approximation(x, y, power, alpha)
    return needed if needed <= _MOST_SEEDS else None


def _power_by_seeds(x: np.ndarray, y: np.ndarray, alpha: float) -> np.ndarray:
    """Returns how often the test of 2, 3, ..., 500 seeds each names the better one."""
    random = np.random.default_rng(0)
    count = np.arange(2, _DRAWN_SEEDS + 1)
    middle = np.mean(x)
    means, variances = [], []
    for values in (x, y):
        drawn = values[random.integers(0, len(values), (_EXPERIMENTS, _DRAWN_SEEDS))] - middle
        sums, squares = (np.cumsum(power, axis=1)[:, 1:] for power in (drawn, drawn**2))
        means.append(sums / count)
        spread = np.maximum(squares - sums**2 / count, 0)
        variances.append(spread / (count - 1) / count)  # of the mean
    difference = (means[0] - means[1]) * np.sign(np.mean(x) - np.mean(y))
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = (count - 1) * sum(variances) ** 2 / (variances[0] ** 2 + variances[1] ** 2)
        t = difference / np.sqrt(sum(variances))
    degrees = np.arange(1, 2 * _DRAWN_SEEDS)
    freedom = np.where(np.isnan(freedom), 1.0, freedom)  # where nothing varies
    critical = np.interp(freedom, degrees, stats.t.isf(alpha / 2, degrees))
    rare_enough = np.array([least_p(n, n) <= alpha for n in count.tolist()])
    return np.mean(t > critical, axis=0) * rare_enough


def _by_normal_approximation(x: np.ndarray, y: np.ndarray, power: float, alpha: float) -> int:
    """Returns the seeds needed where the means are normal and their variances known."""
    quantiles = stats.norm.isf(alpha / 2) + stats.norm.ppf(power)
    return math.ceil(quantiles**2 * (np.var(x) + np.var(y)) / (np.mean(x) - np.mean(y)) ** 2)


def wrong_winner(
    x: ArrayLike, y: ArrayLike, num_seeds: int, draws: int = 10_000, statistic: str = "mean"
) -> float:
    """Returns how often a comparison of few seeds names the wrong one of two configurations.

    Args:
      x: [S] values of one configuration, of many seeds; a seed that failed counts as the worst
        finite value of both.
      y: [S'] values of another.
      num_seeds: the seeds of each that are drawn, with replacement, and compared.
      draws: how often that is done.
      statistic: "mean", "median" or "iqm", of which the higher wins.

    Returns:
      The share of draws whose winner is not that of all seeds; a draw without a winner counts
      half. NaN where all seeds together have no winner.
    """
    x, y = failures_as_worst(x, y)
    random = np.random.default_rng(0)
    function = {"mean": np.mean, "median": np.median, "iqm": iqm}[statistic]
    drawn = [v[random.integers(0, len(v), (draws, num_seeds))] for v in (x, y)]
    truth = np.sign(function(x) - function(y))
    found = np.sign(np.subtract(*(function(values, axis=1) for values in drawn)))
    return float(np.mean(1 - found * truth) / 2) if truth else math.nan
