"""Bootstrap resamples of seeds, shared by everything that has as many seeds.

A mean over a range of ranks, as the interquartile mean is, needs of a resample only how many draws
of the lowest seed, the second lowest, ... lie in that range. Which seed is the lowest does not
matter, so one table of such numbers does for every point of every curve: sorted values times the
table, a product of matrices, are the means of all resamples.
"""

import functools

import numpy as np
from scipy import special

RESAMPLES = 5000
#: Resamples in a product of matrices, and draws that are in memory at once.
_AT_ONCE = 1000
_DRAWS = 2**21


@functools.lru_cache(maxsize=2)
def draws(num_seeds: int) -> np.ndarray:
    """Returns how often each seed is drawn, uint8 [S, 5000]; the same at every call.

    The draws are those of ``scipy.stats.bootstrap(..., rng=np.random.default_rng(0))``.
    """
    counts = np.empty((num_seeds, RESAMPLES), np.uint8)
    random, at_once = np.random.default_rng(0), max(1, _DRAWS // num_seeds)
    for first in range(0, RESAMPLES, at_once):
        drawn = random.integers(0, num_seeds, (min(at_once, RESAMPLES - first), num_seeds))
        drawn += num_seeds * np.arange(len(drawn))[:, None]
        found = np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape)
        counts[:, first : first + len(drawn)] = found.T
    counts.flags.writeable = False
    return counts


@functools.lru_cache(maxsize=2)
def _draws_between(num_seeds: int, low: int, high: int) -> np.ndarray:
    """Returns how many draws of each rank are from the ``low``-th to before the ``high``-th."""
    counts = np.empty((num_seeds, RESAMPLES), np.uint8)
    for some in _parts():
        until = np.cumsum(draws(num_seeds)[:, some], axis=0, dtype=np.int32)
        counts[:, some] = np.diff(np.clip(until, low, high), axis=0, prepend=low)
    counts.flags.writeable = False
    return counts


def _parts() -> list[slice]:
    return [slice(first, first + _AT_ONCE) for first in range(0, RESAMPLES, _AT_ONCE)]


def resampled_trim_means(values: np.ndarray, cut: float = 0.0) -> np.ndarray:
    """Returns the trimmed mean of each resample of the seeds, at each point.

    Args:
      values: [P, S] of P points and S seeds, finite or -inf.
      cut: the fraction of a resample that is trimmed at each end, less than a half.

    Returns:
      [P, 5000], -inf where a value of -inf is not trimmed.
    """
    num_seeds = values.shape[1]
    trimmed = int(cut * num_seeds)
    counts = _draws_between(num_seeds, trimmed, num_seeds - trimmed)
    used = counts.any(axis=1)
    ordered = np.sort(values, axis=1)
    # Sums of how far values are above the middle one have no rounding where all equal it.
    middle = ordered[:, [num_seeds // 2]]
    middle = np.where(np.isneginf(middle), 0.0, middle)
    above = np.where(np.isneginf(ordered), 0.0, ordered - middle)[:, used]
    means = np.empty((len(values), RESAMPLES))
    for some in _parts():
        means[:, some] = above @ counts[used, some].astype(float)
    means /= num_seeds - 2 * trimmed
    means += middle
    lowest = np.argmax(counts > 0, axis=0)
    means[lowest < np.sum(np.isneginf(ordered), axis=1, keepdims=True)] = -np.inf
    return means


def expanded_tail(confidence: float, freedom: int, shrinkage: float = 1.0) -> float:
    """Returns the tail probability at which resamples are read off (Hesterberg 2015).

    The bootstrap's percentile interval is too short for few seeds: a normal quantile stands where
    Student's should, and resampled means spread too little, by sqrt((n - 1) / n). Percentiles
    further out make up for both ("What Teachers Should Know About the Bootstrap", The American
    Statistician 69(4), arXiv:1411.5279: the expanded percentile interval).

    Args:
      confidence: the interval's level.
      freedom: the degrees of freedom of Student's quantile, at least 1.
      shrinkage: how much resamples spread, over how much they should.
    """
    # To the bit those of scipy.stats, which takes half a second to import at the end of a run.
    quantile = special.stdtrit(freedom, (1 - confidence) / 2) / shrinkage
    return float(special.ndtr(quantile))


def percentiles(resampled: np.ndarray, tail: float) -> np.ndarray:
    """Returns the ends [2, P] that cut off the tail of resampled statistics [P, B] on each side."""
    with np.errstate(invalid="ignore"):  # between two resamples that have none
        return np.quantile(resampled, [tail, 1 - tail], axis=-1)
