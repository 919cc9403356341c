"""How fast seeds learn: env steps to a threshold, where some never do, and areas under curves."""

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from mjx_reinforce.statistics import Estimate, enough
from mjx_reinforce.statistics.comparisons import least_p


class Survival(NamedTuple):
    """The Kaplan-Meier estimate of the share of seeds not yet solved, a step function [K].

    steps: the env steps at which it falls (or a seed is censored), ascending.
    probability: the share not yet solved after each of them.
    low, high: its pointwise confidence interval.
    """

    steps: np.ndarray
    probability: np.ndarray
    low: np.ndarray
    high: np.ndarray


def time_to_threshold(
    eval_return: np.ndarray, env_steps: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns each seed's env steps at its first evaluation at or above the threshold.

    A seed that never got there is censored: it needs more than the steps it was trained for.

    Args:
      eval_return: [E, S] the return at each evaluation; one that is not finite solves nothing.
      env_steps: [E, S] the env steps trained until then.
      threshold: the return that counts as solved.

    Returns:
      The steps [S], those of the last evaluation for a censored seed, and who solved it [S].
    """
    reached = np.isfinite(eval_return) & (eval_return >= threshold)
    solved = np.asarray(reached.any(axis=0))
    solving_index = np.where(solved, reached.argmax(axis=0), len(reached) - 1)
    return np.take_along_axis(np.asarray(env_steps), solving_index[None], axis=0)[0], solved


def collapses(eval_return: np.ndarray, threshold: float) -> np.ndarray:
    """Returns which seeds [S] reached the threshold and are below it at the last evaluation.

    Args:
      eval_return: [E, S]; a return that is not finite is below every threshold.
      threshold: the return that counts as solved.
    """
    reached = np.isfinite(eval_return) & (eval_return >= threshold)
    return reached.any(axis=0) & ~reached[-1]


def kaplan_meier(steps: ArrayLike, solved: ArrayLike, confidence: float = 0.95) -> Survival:
    """Returns the share of seeds not yet solved over env steps (Kaplan and Meier 1958).

    Args:
      steps: [S] when each seed solved the task, or how long it was trained without.
      solved: [S] which of the two.
      confidence: the level of the pointwise interval, from Greenwood's variance of the logarithm
        of minus the logarithm; NaN where all seeds or none are left.

    Examples:
      >>> import mjx_reinforce as mr
      >>> curve = mr.kaplan_meier([100, 200, 300], [True, True, False])
      >>> curve.probability.round(2).tolist()
      [0.67, 0.33, 0.33]
    """
    steps = np.asarray(steps, float)
    solved = np.asarray(solved, bool)
    survival = stats.ecdf(stats.CensoredData(uncensored=steps[solved], right=steps[~solved])).sf
    with warnings.catch_warnings():
        # Where all seeds are left, or none: NaN says so.
        warnings.filterwarnings("ignore", "The confidence interval is undefined", RuntimeWarning)
        band = survival.confidence_interval(confidence, method="log-log")
    return Survival(
        survival.quantiles, survival.probabilities, band.low.probabilities, band.high.probabilities
    )


def median_steps(steps: ArrayLike, solved: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Returns the env steps after which half of the seeds have solved the task.

    The interval is Brookmeyer and Crowley's (1982): the steps at which the Kaplan-Meier curve's
    interval contains a half.

    Args:
      steps: as for ``kaplan_meier``.
      solved: as for ``kaplan_meier``.
      confidence: the interval's level.

    Returns:
      Env steps. NaN where half of the seeds never solved it; so is an end of the interval that
      the data do not bound, as both of too few seeds.
    """
    half = _half_solved(steps, solved)
    if not enough(np.size(steps), confidence):
        return Estimate(half, np.nan, np.nan)
    curve = kaplan_meier(steps, solved, confidence)
    # Where an end is not defined, all seeds are left, or none is. Else it is no fraction, so that
    # rounding decides nothing.
    ends = (np.where(np.isnan(x), curve.probability, x) <= 0.5 for x in (curve.low, curve.high))
    return Estimate(half, *(_first(curve.steps, is_below) for is_below in ends))


def restricted_mean(
    steps: ArrayLike, solved: ArrayLike, until: float, confidence: float = 0.95
) -> Estimate:
    """Returns the mean env steps to solve, each seed's counted up to ``until`` at most.

    It is the area under the Kaplan-Meier curve up to there, which exists however few seeds solve
    the task (Royston and Parmar 2013, BMC Medical Research Methodology 13:152). The interval is
    Student's with Greenwood's variance; without censoring before ``until`` it is that of the mean
    of ``min(steps, until)``.

    Args:
      steps: as for ``kaplan_meier``.
      solved: as for ``kaplan_meier``.
      until: env steps above 0, at most those of the longest training.
      confidence: the interval's level.

    Returns:
      Env steps; the interval is NaN for too few seeds, or where all have the same.

    Raises:
      ValueError: no seed was trained for so long.
    """
    steps = np.asarray(steps, float)
    solved = np.asarray(solved, bool)
    if until > steps.max() and not solved.all():
        raise ValueError(f"until: {until:,} env steps, but the longest seed has {steps.max():,.0f}")
    survival = stats.ecdf(stats.CensoredData(uncensored=steps[solved], right=steps[~solved])).sf
    # The curve is a staircase; clipped, its steps beyond ``until`` have no width.
    edges = np.clip(np.concatenate([[0], survival.quantiles, [until]]), 0, until)
    areas = np.diff(edges) * np.concatenate([[1.0], survival.probabilities])
    area_after = np.cumsum(areas[:0:-1])[::-1]  # the area after each of the steps
    num_at_risk = np.sum(steps >= survival.quantiles[:, None], axis=1)
    events = np.sum(steps[solved] == survival.quantiles[:, None], axis=1)
    # Greenwood's terms. After the last seed the area is 0, and 1 avoids 0 / 0.
    survivors = num_at_risk - events
    terms = area_after**2 * events / (num_at_risk * np.where(survivors > 0, survivors, 1))
    num_seeds = len(steps)
    value = float(areas.sum())
    if not (enough(num_seeds, confidence) and terms.any()):
        return Estimate(value, np.nan, np.nan)
    # By n - 1, as the variance of a sample, which it is without censoring.
    error = np.sqrt(terms.sum() * num_seeds / (num_seeds - 1))
    half = float(stats.t.isf((1 - confidence) / 2, num_seeds - 1) * error)
    return Estimate(value, max(value - half, 0.0), min(value + half, until))


class LogRank(NamedTuple):
    """The log-rank test of two groups.

    statistic: standard normal where both solve the task equally soon; above 0 where the first group
      solves it sooner. 0 where no seed solves it, or all at the same env step.
    p_value: two-sided.
    """

    statistic: float
    p_value: float


def log_rank(
    steps: ArrayLike, solved: ArrayLike, other_steps: ArrayLike, other_solved: ArrayLike
) -> LogRank:
    """Tests whether two groups of seeds solve a task equally soon.

    The test compares the whole Kaplan-Meier curves (Mantel 1966, Cancer Chemotherapy Reports 50;
    Peto and Peto 1972), so that seeds that never solved the task count as censored. It takes the
    groups for independent: where both have the same seeds, p is a little too large. However clear
    the difference, p is at least what all orders of so few seeds allow, 0.1 of three and three.

    Args:
      steps: [S] of one group, as for ``kaplan_meier``.
      solved: [S] of the same.
      other_steps: [S'] of the other.
      other_solved: [S'] of the same.

    Examples:
      >>> import mjx_reinforce as mr
      >>> test = mr.log_rank([100, 110, 120, 130], [True] * 4, [900, 910, 920, 930], [True] * 4)
      >>> test.p_value < 0.05
      True
    """
    groups = []
    for times, events in ((steps, solved), (other_steps, other_solved)):
        times = np.asarray(times, float)
        events = np.asarray(events, bool)
        groups.append(stats.CensoredData(uncensored=times[events], right=times[~events]))
    with np.errstate(invalid="ignore"):  # without a difference to see, the statistic is 0 / 0
        test = stats.logrank(*groups)
    # The normal approximation is too sure of few seeds: it may not go beyond their orders.
    most = stats.norm.isf(least_p(np.size(steps), np.size(other_steps)) / 2)
    statistic = float(np.clip(np.nan_to_num(test.statistic), -most, most))
    return LogRank(statistic, float(2 * stats.norm.sf(abs(statistic))))


def mean_while_training(eval_return: np.ndarray, env_steps: np.ndarray, until: float) -> np.ndarray:
    """Returns each seed's mean return over its training [S]: the area under its learning curve.

    The curve is the straight lines between evaluations, and the area is divided by its width.

    Args:
      eval_return: [E, S] the return at each evaluation.
      env_steps: [E, S] the env steps trained until then.
      until: env steps at which the area ends; a curve that ends before counts up to its end.

    Returns:
      In the unit of the return; NaN where a return in the area is not finite.
    """
    means = []
    for returns, steps in zip(eval_return.T, np.asarray(env_steps, float).T, strict=True):
        has_moved = np.diff(steps, prepend=-1) > 0  # a seed that stands still keeps its value
        steps = steps[has_moved]
        returns = returns[has_moved]
        end = min(max(until, steps[0]), steps[-1])
        # The corners of the curve before the end, and the point at which it is cut off.
        is_inside = steps < end
        corners = np.append(steps[is_inside], end)
        heights = np.append(returns[is_inside], np.interp(end, steps, returns))
        width = corners[-1] - corners[0]
        means.append(np.trapezoid(heights, corners) / width if width else heights[0])
    return np.array(means)


def _half_solved(steps: ArrayLike, solved: ArrayLike) -> float:
    """Returns the first step after which at most half of the seeds are left, NaN if there is none.

    The share that is left is counted in whole numbers: the product of fractions that scipy rounds
    may come out above a half where it is one.
    """
    steps = np.asarray(steps, float)
    solved = np.asarray(solved, bool)
    times, events = np.unique(steps[solved], return_counts=True)
    at_risk = len(steps) - np.searchsorted(np.sort(steps), times)
    # The share is numerator / denominator, in Python's integers, which have no end.
    numerator = 1
    denominator = 1
    for time, risk, count in zip(times.tolist(), at_risk.tolist(), events.tolist(), strict=True):
        numerator *= risk - count
        denominator *= risk
        if 2 * numerator <= denominator:
            return time
    return float("nan")


def _first(steps: np.ndarray, holds: np.ndarray) -> float:
    """Returns the first of the steps at which something holds, NaN if it never does."""
    if not holds.any():
        return float("nan")
    return float(steps[holds.argmax()])
