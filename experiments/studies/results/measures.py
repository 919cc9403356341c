"""What the results page says of returns: verdicts, shares solved, curves over seeds."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.studies.results.tasks import PUBLISHED_SEEDS
from mjx_reinforce.reports.curves import on_grid
from mjx_reinforce.reports.statistics import Estimate, iqm, iqm_interval
from mjx_reinforce.reports.statistics.aggregates import interval

#: Points of a curve, denser where training begins.
_POINTS = 81
#: Quantiles over seeds that are kept of a curve.
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)


def published_interval(mean: float, deviation: float) -> Estimate:
    """Returns a published mean with its 95 % interval by Student's t over the published seeds.

    Seeds that are all alike have none.
    """
    t = stats.t.ppf(0.975, PUBLISHED_SEEDS - 1)
    half = float(t) * deviation / math.sqrt(PUBLISHED_SEEDS)
    return Estimate(mean, mean - half, mean + half) if half else Estimate(mean, math.nan, math.nan)


def verdict(ours: Estimate, published: tuple[float, float] | None) -> str:
    """Returns where our mean is: "above", "below" or "not apart" from a published one.

    Args:
      ours: with its interval; NaN where a seed failed.
      published: mean and standard deviation over seeds; None where there is none.
    """
    if published is None:
        return "none published"
    if math.isnan(ours.value):
        return "none: a seed failed"
    theirs = published_interval(*published)
    if not np.all(np.isfinite([*ours, *theirs])):
        return "not apart" if ours.value == theirs.value else "no interval"
    if ours.low > theirs.high:
        return "above"
    return "below" if ours.high < theirs.low else "not apart"


def solved_within(steps_to_solve: ArrayLike, limit: float) -> int:
    """Returns how many seeds were solved at an evaluation up to so many env steps.

    Args:
      steps_to_solve: [S] env steps at the first evaluation that was solved; inf where none was.
      limit: env steps.
    """
    return int(np.sum(np.asarray(steps_to_solve) <= limit))


def steps_quantile(steps_to_solve: ArrayLike, share: float) -> float:
    """Returns the env steps within which a share of the seeds was solved; inf if it never was."""
    ordered = np.sort(np.asarray(steps_to_solve, float))
    return float(ordered[max(0, math.ceil(share * len(ordered)) - 1)])


def least_share_solved(
    returns: np.ndarray, steps: np.ndarray, threshold: float, start: float, stop: float
) -> float:
    """Returns the least share of seeds that are solved at once, from ``start`` to ``stop``.

    At every number of env steps in between a seed is as its last evaluation until then showed it.

    Args:
      returns: [E, S] at each evaluation; one that is not finite is not solved.
      steps: [E, S] the seed's env steps until then; the first evaluation's are 0.
      threshold: the return that counts as solved.
      start: env steps.
      stop: env steps; NaN is returned where all seeds were trained for less. One that was trained
        for less than others keeps its last return.
    """
    if steps[-1].max() < stop:
        return math.nan
    at, share = _share_over_steps(returns, steps, threshold)
    first = np.searchsorted(at, start, side="right") - 1
    last = np.searchsorted(at, stop, side="right")
    return float(share[first:last].min())


def _share_over_steps(
    returns: np.ndarray, steps: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns all numbers of env steps at which seeds were evaluated, and the share solved."""
    solved = np.isfinite(returns) & (returns >= threshold)
    change = np.diff(solved.astype(int), axis=0, prepend=0)
    at, place = np.unique(steps, return_inverse=True)
    changes = np.bincount(place.ravel(), weights=change.ravel(), minlength=len(at))
    return at, np.cumsum(changes) / returns.shape[1]


def curves(
    returns: np.ndarray, steps: np.ndarray, threshold: float | None, budget: float
) -> dict[str, np.ndarray]:
    """Returns the learning curve over seeds by column, on a grid of env steps [K].

    Args:
      returns: [E, S] at each evaluation.
      steps: [E, S] env steps until then.
      threshold: the return that counts as solved, if any.
      budget: the env steps at which the curve ends; a seed that ended before keeps its return.

    Returns:
      ``env_steps``; the interquartile mean ``iqm`` with its 95 % interval ``low`` and ``high``;
      quantiles ``q0``, ``q5``, ..., each the return of a seed; and the share ``solved``, NaN
      without a threshold.
    """
    grid = min(budget, steps[-1].max()) * np.linspace(0, 1, _POINTS) ** 2
    on = on_grid(grid, steps, returns)
    low, high = iqm_interval(on)
    worst = np.where(np.isfinite(on), on, -np.inf)
    values = np.quantile(worst, QUANTILES, axis=1, method="inverted_cdf")
    solved = np.full(len(grid), math.nan)
    if threshold is not None:
        at, share = _share_over_steps(returns, steps, threshold)
        solved = share[np.searchsorted(at, grid, side="right") - 1]
    named = {f"q{100 * q:g}": x for q, x in zip(QUANTILES, values, strict=True)}
    found = {"env_steps": grid, "iqm": iqm(on), "low": low, "high": high, **named}
    return found | {"solved": solved}


class Comparison(NamedTuple):
    """A policy's returns in our simulation and in Gymnasium's.

    ours, gymnasium: the mean over episodes with its interval
    difference: Gymnasium's less ours, with Welch's interval
    within: whether Gymnasium's mean is within our interval
    """

    ours: Estimate
    gymnasium: Estimate
    difference: Estimate
    within: bool


def compare(ours: ArrayLike, theirs: ArrayLike) -> Comparison:
    """Compares the returns [N] of episodes in two simulations."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    first, second = interval("mean", ours), interval("mean", theirs)
    difference = float(second.value - first.value)
    low = high = math.nan
    if ours.std() > 0 or theirs.std() > 0:
        welch = stats.ttest_ind(theirs, ours, equal_var=False).confidence_interval(0.95)
        low, high = float(welch.low), float(welch.high)
    within = bool(first.low <= second.value <= first.high) or difference == 0
    return Comparison(first, second, Estimate(difference, low, high), within)
