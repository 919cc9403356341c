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
    draw_counts = np.empty((num_seeds, RESAMPLES), np.uint8)
    random = np.random.default_rng(0)
    block_size = max(1, _DRAWS // num_seeds)
    # Blocks draw what one call would: the generator fills its arrays in the order of their rows.
    for start in range(0, RESAMPLES, block_size):
        seeds = random.integers(0, num_seeds, (min(block_size, RESAMPLES - start), num_seeds))
        # Each resample counts in numbers of its own, so that one call counts all of the block.
        seeds += num_seeds * np.arange(len(seeds))[:, None]
        seed_counts = np.bincount(seeds.ravel(), minlength=seeds.size).reshape(seeds.shape)
        draw_counts[:, start : start + len(seeds)] = seed_counts.T
    # The cache hands the same array to everyone.
    draw_counts.flags.writeable = False
    return draw_counts


@functools.lru_cache(maxsize=2)
def _draws_between(num_seeds: int, low: int, high: int) -> np.ndarray:
    """Returns how many draws of each rank are from the ``low``-th to before the ``high``-th."""
    draw_counts = np.empty((num_seeds, RESAMPLES), np.uint8)
    for block in _blocks():
        # How many draws of a resample are of this seed or of lower ones, cut to the range.
        cumulated_draws = np.cumsum(draws(num_seeds)[:, block], axis=0, dtype=np.int32)
        draw_counts[:, block] = np.diff(np.clip(cumulated_draws, low, high), axis=0, prepend=low)
    draw_counts.flags.writeable = False
    return draw_counts


def _blocks() -> list[slice]:
    return [slice(start, start + _AT_ONCE) for start in range(0, RESAMPLES, _AT_ONCE)]


def resampled_trim_means(values: np.ndarray, cut: float = 0.0) -> np.ndarray:
    """Returns the trimmed mean of each resample of the seeds, at each point.

    Args:
      values: [P, S] of P points and S seeds, finite or -inf.
      cut: the fraction of a resample that is trimmed at each end, less than a half.

    Returns:
      [P, 5000], -inf where a value of -inf is not trimmed.
    """
    num_seeds = values.shape[1]
    num_trimmed = int(cut * num_seeds)
    draw_counts = _draws_between(num_seeds, num_trimmed, num_seeds - num_trimmed)
    # The lowest and highest seeds may lie in no resample's range: the product leaves them out.
    ranks = draw_counts.any(axis=1)
    sorted_values = np.sort(values, axis=1)
    # Sums of how far values are above the middle one have no rounding where all equal it.
    medians = sorted_values[:, [num_seeds // 2]]
    medians = np.where(np.isneginf(medians), 0.0, medians)
    deviations = np.where(np.isneginf(sorted_values), 0.0, sorted_values - medians)[:, ranks]
    means = np.empty((len(values), RESAMPLES))
    for block in _blocks():
        means[:, block] = deviations @ draw_counts[ranks, block].astype(float)
    means /= num_seeds - 2 * num_trimmed
    means += medians
    # The product has 0 in place of -inf, which times 0 would be NaN. A mean is -inf if its lowest
    # rank is.
    lowest_rank = np.argmax(draw_counts > 0, axis=0)
    means[lowest_rank < np.sum(np.isneginf(sorted_values), axis=1, keepdims=True)] = -np.inf
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


def percentiles(resampled_means: np.ndarray, tail: float) -> np.ndarray:
    """Returns the ends [2, P] that cut off the tail of resampled statistics [P, B] on each side."""
    with np.errstate(invalid="ignore"):  # between two resamples that have none
        return np.quantile(resampled_means, [tail, 1 - tail], axis=-1)
