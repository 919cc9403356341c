"""How far a run is, how well it does, how fast it goes, and how long it still takes."""

import math
from typing import NamedTuple

import numpy as np

from mjx_reinforce.reports.statistics import iqm

#: The time left is estimated from so many of the latest blocks: episodes change their length.
BLOCKS = 10


class Progress(NamedTuple):
    """How far a run is, as of its last evaluation.

    fraction: how much of its budget the seed furthest from its end has used, 1 or more at the end
    updates: made by the seed that made the most
    env_steps: of the mean seed
    iqm: interquartile mean of the return over seeds, NaN where failed seeds reach the middle half
    worst: the return of the worst seed, NaN if one failed
    failed: how many seeds have a return that is not finite
    num_seeds: of how many
    env_steps_per_second: of all seeds together, the mean since the start
    latest_per_second: the same of the last block of updates, NaN before the first
    seconds_left: estimated from the latest blocks, NaN before the first
    """

    fraction: float
    updates: int
    env_steps: float
    iqm: float
    worst: float
    failed: int
    num_seeds: int
    env_steps_per_second: float
    latest_per_second: float
    seconds_left: float


def measure_progress(past: dict[str, np.ndarray], fractions: np.ndarray) -> Progress:
    """Returns how far a run is.

    Args:
      past: its last E evaluations, at most ``BLOCKS`` + 1: ``eval_return``, ``env_steps`` and
        ``updates`` [E, S], and ``seconds`` [E] since compilation ended.
      fractions: [E] of the budget used, by the seed furthest from its end.
    """
    returns, seconds = past["eval_return"][-1], past["seconds"]
    total = past["env_steps"].sum(axis=-1)
    progressed = _slope(fractions, seconds)
    left = max(1.0 - float(fractions[-1]), 0.0)
    return Progress(
        fraction=float(fractions[-1]),
        updates=int(past["updates"][-1].max()),
        env_steps=float(past["env_steps"][-1].mean()),
        iqm=float(iqm(returns)),
        worst=float(returns.min()),
        failed=int(np.sum(~np.isfinite(returns))),
        num_seeds=len(returns),
        env_steps_per_second=float(total[-1] / seconds[-1]) if seconds[-1] > 0 else math.nan,
        latest_per_second=_slope(total[-2:], seconds[-2:]),
        seconds_left=left / progressed if progressed > 0 else math.nan,
    )


def _slope(values: np.ndarray, seconds: np.ndarray) -> float:
    """Returns how much the values grew a second, NaN where no time passed."""
    passed = seconds[-1] - seconds[0]
    return float((values[-1] - values[0]) / passed) if passed > 0 else math.nan
