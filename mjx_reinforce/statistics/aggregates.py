"""One number for many seeds and how sure it is: means, the lower tail, rates."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from mjx_reinforce.statistics import (
    Estimate,
    finite_or_nan,
    mean_interval,
    worst_if_not_finite,
)


def estimate_mean(values: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Returns the mean over seeds with its confidence interval, see ``mean_interval``.

    Args:
      values: [..., S], the seeds last; not finite where a seed failed.
      confidence: the interval's level.

    Returns:
      Arrays [...]. NaN stands for what does not exist: the mean where a seed failed, an end that
      such resamples decide, both ends where seeds are too few or all alike.
    """
    values = worst_if_not_finite(values)
    return Estimate(finite_or_nan(np.mean(values, axis=-1)), *mean_interval(values, confidence))


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


def cvar(values: ArrayLike, fraction: float = 0.1) -> np.ndarray:
    """Returns the mean of the worst ``fraction`` of the seeds, [...] of values [..., S].

    The conditional value at risk (Rockafellar and Uryasev 2000, Journal of Risk 2(3)). Where
    ``fraction * S`` is not whole, the last seed of the tail counts in part; fewer than
    ``1 / fraction`` seeds give their minimum. NaN where a seed failed.
    """
    ordered = np.sort(worst_if_not_finite(values), axis=-1)
    size = fraction * ordered.shape[-1]
    weights = np.clip(size - np.arange(math.ceil(size)), 0, 1) / size
    tail = ordered[..., : len(weights)]
    with np.errstate(invalid="ignore"):  # of failed seeds
        return finite_or_nan(tail[..., -1] + (tail - tail[..., -1:]) @ weights)
