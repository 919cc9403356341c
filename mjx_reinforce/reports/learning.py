"""How fast configurations learn, pair by pair."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import COMPARED, Result, shared_seeds
from mjx_reinforce.reports.statistics.comparisons import Comparison, compare_all, holm
from mjx_reinforce.reports.statistics.survival import log_rank


class SpeedTest(NamedTuple):
    """The log-rank test of two results, ``first`` and ``second`` being their places.

    p_value: that both solve the task equally soon
    adjusted: the same after Holm's correction for all pairs
    """

    first: int
    second: int
    p_value: float
    adjusted: float


class Learning(NamedTuple):
    """How fast the results learn.

    until: env steps at which the areas end and the mean env steps to solve are cut off
    speeds: of all pairs of the best results; empty where the task has no threshold
    areas: the same pairs by the mean return over the training
    """

    until: int
    speeds: list[SpeedTest]
    areas: list[Comparison]


def compare_learning(results: Sequence[Result], until: int) -> Learning:
    """Compares how fast results learn; see ``Learning``."""
    best = results[:COMPARED]
    shared = shared_seeds(best)
    areas = [each.areas[np.isin(each.configuration.seed, shared)] for each in best]
    pairs = compare_all(areas) if len(best) > 1 and len(shared) > 1 else []
    return Learning(until, _speeds(best), pairs)


def fastest(results: Sequence[Result]) -> int:
    """Returns the place of the result with the fewest mean env steps to solve."""
    means = [float(each.solving.mean.value) if each.solving else np.inf for each in results]
    return int(np.argmin(means))


def _speeds(results: Sequence[Result]) -> list[SpeedTest]:
    solving = [each.solving for each in results if each.solving is not None]
    pairs = list(itertools.combinations(range(len(solving)), 2))
    found = [
        log_rank(solving[i].steps, solving[i].solved, solving[j].steps, solving[j].solved).p_value
        for i, j in pairs
    ]
    return [
        SpeedTest(i, j, p_value, float(adjusted))
        for (i, j), p_value, adjusted in zip(pairs, found, holm(found), strict=True)
    ]
