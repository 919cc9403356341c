"""Performance profiles: the share of seeds above each return."""

import numpy as np
from numpy.typing import ArrayLike

from mjx_reinforce.reports.statistics import Estimate, worst_if_not_finite
from mjx_reinforce.reports.statistics.aggregates import wilson


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
