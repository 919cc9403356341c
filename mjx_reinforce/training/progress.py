"""How far a run is, how well it does, how fast it goes, and how long it still takes.

Updates may meet numbers that are not finite: which ones, and when a seed is past hope.
"""

import math
from typing import NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import iqm

#: The time left is estimated from so many of the latest blocks: episodes change their length.
BLOCKS = 10


def used(config: Config, env_steps: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns the fraction of its budget that each seed has used, of counts [..., S]."""
    fraction = np.zeros(env_steps.shape)
    if config.env_steps is not None:
        fraction = env_steps / config.env_steps
    if config.max_updates is not None:
        fraction = np.maximum(fraction, updates / config.max_updates)
    return fraction


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


#: Why a run that is ``hopeless`` is stopped.
HOPELESS = (
    "every seed that still trained was broken throughout the last updates, its episodes "
    "or its new policy not finite; lower --learning-rate (ars: --step-size) or mend the task"
)
#: A run is not given up before each of its seeds was broken so many updates in a row: blocks may
#: be shorter, and a seed may recover from one such update, since the next draws other numbers.
_FEWEST = 5
#: A message names so many seeds.
_NAMED = 5


def nonfinite_updates(metrics: Arrays) -> np.ndarray:
    """Returns how many updates of a block met numbers which are not finite, of each seed [S].

    Args:
      metrics: [K, S] each, as for ``Record.add``.
    """
    broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
    return (broken & metrics["active"]).sum(axis=0)


def broken_in_a_row(before: np.ndarray, metrics: Arrays) -> np.ndarray:
    """Returns how many of its latest updates each seed was broken in, without one between.

    An update is broken if all its episodes left the finite numbers, or if it was skipped.

    Args:
      before: [S] the same before this block.
      metrics: [K, S] each, as for ``Record.add``.
    """
    broken = metrics["nonfinite_episodes"] >= metrics["episodes"]
    broken |= metrics["skipped_update"] > 0
    count = before
    for active_now, broken_now in zip(metrics["active"], broken, strict=True):
        count = np.where(active_now, np.where(broken_now, count + 1, 0), count)
    return count


def hopeless(in_a_row: np.ndarray, used: np.ndarray, block: int) -> bool:
    """Returns whether every seed that still trains was broken throughout a block of updates.

    Args:
      in_a_row: [S] from ``broken_in_a_row``.
      used: [S] the fraction of its budget that each seed has used.
      block: updates in a block; fewer than five count as five.
    """
    training = used < 1.0
    return bool(training.any() and np.all(in_a_row[training] >= max(block, _FEWEST)))


def describe_nonfinite(met: np.ndarray, first_seed: int, updates: int) -> str:
    """Returns one line about ``nonfinite_updates`` of which at least one is not 0.

    Args:
      met: [S] how many of a block, of each seed.
      first_seed: the number of the first seed.
      updates: how many there were after the block.
    """
    seeds = (first_seed + np.flatnonzero(met)).tolist()
    named = ", ".join(map(str, seeds[:_NAMED])) + (", ..." if len(seeds) > _NAMED else "")
    return (
        f"up to update {updates}: {len(seeds):,} of {len(met):,} seeds met numbers that are not "
        f"finite or beyond 1e10 ({named}), in {met.sum():,} updates"
    )
