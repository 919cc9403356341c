"""Trimmed means of bootstrap resamples of seeds, for many curve points at once.

A resample is how often each seed was drawn. Sorted by their values at a point, the seeds' draws add
up to ranks, and of each seed those draws count whose rank is not trimmed. Only of the seeds near
the two cuts does this depend on the resample: those between them count with all their draws, which
is a product of matrices, and those outside not at all. So nothing is sorted but the values.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np

_RESAMPLES = 5000
#: Draws that are in memory at once.
_DRAWS = 2**21
#: Seeds on each side of a cut that are looked at one by one, in standard deviations of the number
#: of draws below the cut. A point where that is not enough for some resample, which is rare, is
#: done again with all of its seeds.
_DEVIATIONS = 5


def resampled_trim_means(values: np.ndarray, cut: float) -> np.ndarray:
    """Returns the trimmed mean of each resample of the seeds, at each point.

    Args:
      values: [P, S] of P points and S seeds, finite or -inf.
      cut: the fraction of a resample that is trimmed at each end, less than a half.

    Returns:
      [P, 5000], -inf where a value of -inf is not trimmed.
    """
    num_seeds = values.shape[1]
    trimmed = int(cut * num_seeds)
    reach = math.ceil(_DEVIATIONS * math.sqrt(num_seeds * cut * (1 - cut)))
    means = []
    for draws in _resamples(num_seeds):
        found, sure = _trim_means(values, draws, trimmed, reach)
        if not sure.all():
            found[~sure], _ = _trim_means(values[~sure], draws, trimmed, num_seeds)
        means.append(found)
    return np.concatenate(means, axis=1)


def _resamples(num_seeds: int) -> Iterator[np.ndarray]:
    """Yields how often each seed is drawn, [S, B] of B resamples, until there are 5000.

    The generator is that of ``scipy.stats.bootstrap(..., rng=np.random.default_rng(0))``, and so
    are the draws.
    """
    random = np.random.default_rng(0)
    at_once = max(1, _DRAWS // num_seeds)
    for first in range(0, _RESAMPLES, at_once):
        size = min(at_once, _RESAMPLES - first)
        drawn = random.integers(0, num_seeds, (size, num_seeds))
        drawn += num_seeds * np.arange(size)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape)
        yield counts.T.astype(np.int32, order="C")


def _trim_means(
    values: np.ndarray, draws: np.ndarray, trimmed: int, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the trimmed means [P, B], and of which points [P] they are right for sure.

    Args:
      values: [P, S] as for ``resampled_trim_means``.
      draws: [S, B] how often each seed was drawn.
      trimmed: how many draws are left out at each end.
      reach: seeds on each side of a cut that are looked at one by one.
    """
    num_seeds = len(draws)
    order = np.argsort(values, axis=1)
    rank = np.argsort(order, axis=1)
    middle, above, failed = _from_the_middle(values, order)
    near = _near_cuts(num_seeds, trimmed, reach)
    cuts = (trimmed, num_seeds - trimmed)
    between = (near[0].stop <= rank) & (rank < near[-1].start)
    as_float = draws.astype(float)
    sums = np.where(between, above, 0.0) @ as_float
    sure = np.ones(len(values), bool)
    for ranks, cut in zip(near, cuts, strict=False):
        before = ((rank < ranks.start) @ as_float).astype(draws.dtype)
        for p, seeds in enumerate(order[:, ranks]):
            until = _running_sums(before[p], draws[seeds])
            sure[p] &= until[0].max() <= cut <= until[-1].min()
            sums[p] += above[p, seeds] @ np.diff(np.clip(until, *cuts), axis=0)
    means = middle + sums / (cuts[1] - cuts[0])
    return np.where(failed @ as_float > trimmed, -np.inf, means), sure


def _from_the_middle(
    values: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a value amid the others [P, 1], how far above it all are, and which are -inf [P, S].

    Sums of these have no rounding where all that is summed equals the one in the middle. In them
    a value of -inf, which is trimmed or else decides, is the least of the finite ones.
    """
    failed = np.isneginf(values)
    least = np.min(values, axis=1, keepdims=True, where=~failed, initial=np.inf)
    finite = np.where(failed, np.where(np.isinf(least), 0.0, least), values)
    middle = np.take_along_axis(finite, order[:, [values.shape[1] // 2]], axis=1)
    return middle, finite - middle, failed


def _near_cuts(num_seeds: int, trimmed: int, reach: int) -> list[slice]:
    """Returns the ranks around the lower and the upper cut; all of them, if these would overlap."""
    low = slice(max(trimmed - reach, 0), trimmed + reach)
    high = slice(num_seeds - low.stop, num_seeds - low.start)
    return [low, high] if low.stop < high.start else [slice(0, num_seeds)]


def _running_sums(first: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Returns ``first`` [B] and the sums of it and the first 1, 2, ..., L of the rows [L, B].

    Row by row, as ``np.cumsum`` along the first axis takes several times as long.
    """
    sums = np.concatenate([first[None], rows])
    for before, now in itertools.pairwise(sums):
        now += before
    return sums
