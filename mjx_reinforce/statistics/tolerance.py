"""Bounds that a share of all runs keeps, with some confidence, whatever their distribution."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from mjx_reinforce.statistics import finite_or_nan, worst_if_not_finite


def lower_tolerance(values: ArrayLike, share: float = 0.9, confidence: float = 0.95) -> float:
    """Returns a bound that at least a share of all runs returns or exceeds (Wilks 1941).

    It is one of the values themselves, the highest that holds with this confidence for every
    distribution: the r-th lowest of S, if fewer than r of S runs are among the lowest
    ``1 - share`` of all with a probability of at most ``1 - confidence``.

    Args:
      values: [S] of the seeds; not finite where one failed.
      share: of all runs.
      confidence: how often a bound of S seeds holds.

    Returns:
      NaN if the seeds are fewer than ``tolerance_seeds``, or the value is of a seed that failed.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> mr.lower_tolerance(np.arange(29.0)), mr.lower_tolerance(np.arange(46.0))
      (0.0, 1.0)
    """
    sorted_values = np.sort(worst_if_not_finite(values))
    num_seeds = len(sorted_values)
    # P(fewer than r of S runs are in the lowest share), for r = 1, ..., S.
    is_held = special.bdtr(np.arange(num_seeds), num_seeds, 1 - share) <= 1 - confidence
    if not is_held.any():
        return math.nan
    return float(finite_or_nan(sorted_values[np.flatnonzero(is_held)[-1]]))


def tolerance_seeds(share: float = 0.9, confidence: float = 0.95) -> int:
    """Returns how many seeds a bound of ``lower_tolerance`` takes: 29 for 90% with 95%.

    Of fewer, too often none is among the lowest ``1 - share`` of all.
    """
    return math.ceil(math.log(1 - confidence) / math.log(share))
