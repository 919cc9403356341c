"""One number for many seeds and how sure it is: means, the lower tail, rates."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from mjx_reinforce.statistics import (
    Estimate,
    bootstrap,
    finite_or_nan,
    iqm,
    iqm_interval,
    mean_interval,
    worst_if_not_finite,
)

#: Fewer seeds in the tail than this have no interval: at 95 % none covers, see docs/statistics.md.
_LEAST_TAIL = 5


def interval(
    statistic: str, values: ArrayLike, *, confidence: float = 0.95, fraction: float = 0.1
) -> Estimate:
    """Returns a statistic over seeds with its confidence interval.

    The mean and the IQM have Hesterberg's expanded percentile bootstrap
    (``bootstrap.expanded_tail``), CVaR has the bootstrap t (``cvar_interval``). docs/statistics.md
    says how often each covers the truth.

    Args:
      statistic: "mean", "iqm" or "cvar".
      values: [..., S], the seeds last; not finite where a seed failed, which counts as the worst.
      confidence: the interval's level.
      fraction: of the seeds, that ``cvar`` is the mean of.

    Returns:
      Arrays [...]. NaN stands for what does not exist: a statistic that a failed seed decides, an
      end that such resamples decide, both ends where seeds are too few or all alike.

    Raises:
      ValueError: an unknown statistic.
    """
    known = ("mean", "iqm", "cvar")
    if statistic not in known:
        raise ValueError(f"statistic: {statistic!r} is unknown; choose one of {', '.join(known)}")
    values = worst_if_not_finite(values)
    if statistic == "mean":
        return Estimate(finite_or_nan(np.mean(values, axis=-1)), *mean_interval(values, confidence))
    if statistic == "iqm":
        return Estimate(iqm(values), *iqm_interval(values, confidence=confidence))
    return Estimate(cvar(values, fraction), *cvar_interval(values, fraction, confidence))


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Returns a rate with Wilson's score interval (Wilson 1927), as scipy's ``binomtest`` has it.

    Args:
      successes: how many seeds did it, an array or a number, whole or not.
      trials: of how many, above 0.
      confidence: the interval's level.
    """
    trials = np.asarray(trials)
    rate = np.asarray(successes) / trials
    z = stats.norm.isf((1 - confidence) / 2)
    middle = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(rate * (1 - rate) / trials + (z / (2 * trials)) ** 2) / (1 + z**2 / trials)
    low = np.where(rate == 0, 0.0, middle - half)[()]
    return Estimate(rate, low, np.where(rate == 1, 1.0, middle + half)[()])


def performance_profile(
    values: ArrayLike, thresholds: ArrayLike, confidence: float = 0.95
) -> Estimate:
    """Returns the share of seeds above each threshold (Agarwal et al. 2021, section 4.2).

    Args:
      values: [S] a return a seed; one that is not finite is above nothing.
      thresholds: [K] returns.
      confidence: the level of the band, which holds at each threshold alone: Wilson's interval.

    Returns:
      Arrays [K].
    """
    ordered = np.sort(worst_if_not_finite(values))
    above = len(ordered) - np.searchsorted(ordered, thresholds, side="right")
    return wilson(above, len(ordered), confidence)


def cvar(values: ArrayLike, fraction: float = 0.1) -> np.ndarray:
    """Returns the mean of the worst ``fraction`` of the seeds, [...] of values [..., S].

    The conditional value at risk (Rockafellar and Uryasev 2000, Journal of Risk 2(3)). Where
    ``fraction * S`` is not whole, the last seed of the tail counts in part; fewer than
    ``1 / fraction`` seeds give their minimum. NaN where a seed failed.
    """
    ordered = np.sort(worst_if_not_finite(values), axis=-1)
    weights = _weights(np.arange(ordered.shape[-1] + 1.0), fraction)
    weights = weights[weights > 0]
    tail = ordered[..., : len(weights)]
    with np.errstate(invalid="ignore"):  # of failed seeds
        return finite_or_nan(tail[..., -1] + (tail - tail[..., -1:]) @ weights)


def cvar_interval(
    values: ArrayLike, fraction: float = 0.1, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a confidence interval of ``cvar``: the bootstrap t (Efron and Tibshirani 1993, 12.5).

    Its standard error is that of the mean of ``q + min(x - q, 0) / fraction``, q being the
    quantile at ``fraction``, which is what CVaR is to first order (Trindade et al. 2007).

    Args:
      values: [..., S]; not finite where a seed failed.
      fraction: of the seeds.
      confidence: the interval's level.

    Returns:
      Its lower and upper ends [...]. NaN where the data do not bound it: with a failed seed, a tail
      of seeds that are all alike, or fewer than five seeds in the tail (50 seeds, for a tenth), as
      nothing is known of what lies below them.
    """
    ordered = np.sort(worst_if_not_finite(values), axis=-1)
    num_seeds = ordered.shape[-1]
    ends = np.full((2, *ordered.shape[:-1]), np.nan)
    if fraction * num_seeds >= _LEAST_TAIL:
        rows = ordered.reshape(-1, num_seeds)
        known = np.isfinite(rows[:, 0])
        found = np.full((2, len(rows)), np.nan)
        found[:, known] = _bootstrap_t(rows[known], fraction, confidence)
        ends = finite_or_nan(found).reshape(ends.shape)
    return ends[0][()], ends[1][()]


def _bootstrap_t(ordered: np.ndarray, fraction: float, confidence: float) -> np.ndarray:
    """Returns the ends [2, P] for sorted values [P, S]; infinite where nothing bounds them."""
    num_seeds = ordered.shape[1]
    middle, above = bootstrap.from_the_middle(ordered)
    value, error = _cvar_and_error(above, np.ones((num_seeds, 1)), fraction)
    resampled, errors = _cvar_and_error(above, bootstrap.draws(num_seeds), fraction)
    apart = resampled - value
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(apart == 0, 0.0, apart / errors)
    tail = (1 - confidence) / 2
    low, high = np.quantile(t, [tail, 1 - tail], axis=1, method="closest_observation")
    value, error = value[:, 0], error[:, 0]
    with np.errstate(invalid="ignore"):
        ends = np.stack([value - high * error, value - low * error])
    return middle[:, 0] + np.where(error > 0, ends, np.nan)


def _cvar_and_error(
    ordered: np.ndarray, counts: np.ndarray, fraction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns CVaR and its standard error, [P, B], for resamples of sorted values [P, S].

    Args:
      ordered: [P, S], each row's values from the lowest.
      counts: [S, B] how often each rank is drawn.
      fraction: of the seeds.
    """
    num_seeds = len(counts)
    until = np.cumsum(counts, axis=0, dtype=float)
    weights = _weights(np.concatenate([np.zeros((1, until.shape[1])), until]), fraction)
    quantile = ordered[:, np.argmax(until >= fraction * num_seeds, axis=0)]
    used = weights.any(axis=1)
    mean, square = (power[:, used] @ weights[used] for power in (ordered, ordered**2))
    spread = (square - 2 * quantile * mean + quantile**2) / fraction - (mean - quantile) ** 2
    rounding = 1e-12 * np.max(ordered**2, axis=1, keepdims=True)
    return mean, np.sqrt(np.where(spread > rounding, spread, 0) / num_seeds)


def _weights(until: np.ndarray, fraction: float) -> np.ndarray:
    """Returns the ranks' weights in the mean of the lowest draws, [S, ...], which add up to 1.

    Args:
      until: [S + 1, ...] how many draws are of the first 0, 1, ..., S ranks.
      fraction: the share of the draws that the mean is of.
    """
    tail = fraction * (len(until) - 1)
    return np.diff(np.minimum(until, tail), axis=0) / tail
