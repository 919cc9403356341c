"""What few seeds would have concluded, resampled from the many of the study."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from experiments.studies.seeds.answers import CONTRASTS, LEVEL, MEASURES, Contrast, at_best
from experiments.studies.seeds.runs import Task
from mjx_reinforce.statistics.comparisons import holm, paired_difference, seeds_needed, wrong_winner

#: Numbers of seeds of the tables.
COUNTS = (3, 5, 10, 30, 100)
_DRAWS = 1000


class FewSeeds(NamedTuple):
    """What few seeds would have said of two arms, each at its best learning rate.

    wrong: how often the mean of so many seeds of each names the wrong one
    needed: seeds of each with which a t-test finds the difference in 80% of cases; None above
      10,000
    adjusted: the p value of no difference, of all seeds together, after Holm's correction for all
      of these
    """

    task: str
    contrast: str
    measure: str
    wrong: dict[int, float]
    needed: int | None
    adjusted: float

    @property
    def sure(self) -> bool:
        """Whether all seeds together say which one is better."""
        return self.adjusted < LEVEL

    @property
    def equal(self) -> bool:
        """Whether all seeds together have the same mean in both arms, so that none is wrong."""
        return all(math.isnan(wrong) for wrong in self.wrong.values())


def few_seeds(
    tasks: Sequence[Task], measures: Sequence[str], counts: Sequence[int]
) -> list[FewSeeds]:
    """Returns what few seeds would have said of every comparison, by their means.

    Args:
      tasks: what was measured.
      measures: by which one of two arms wins.
      counts: how many seeds.
    """
    found = [_few_seeds(t, c, m, counts) for m in measures for t in tasks for c in CONTRASTS]
    adjusted = holm([few.adjusted for few in found])
    return [few._replace(adjusted=float(p)) for few, p in zip(found, adjusted, strict=True)]


def _few_seeds(task: Task, contrast: Contrast, measure: str, counts: Sequence[int]) -> FewSeeds:
    """Returns the same of one comparison, its p value not yet corrected."""
    sign = MEASURES[measure].sign
    first, second = (sign * values for values in at_best(task, measure, contrast))
    return FewSeeds(
        task=task.name,
        contrast=contrast.name,
        measure=measure,
        wrong={count: wrong_winner(first, second, count) for count in counts},
        needed=seeds_needed(first, second),
        adjusted=float(paired_difference(first, second).p_value),
    )


class AnyPair(NamedTuple):
    """What few seeds would have said of all pairs of configurations that surely differ.

    wrong: how often the mean of so many seeds of each names the wrong one, the mean over pairs
    pairs: how many these are
    """

    task: str
    measure: str
    wrong: dict[int, float]
    pairs: int


def any_pair(task: Task, measure: str, counts: Sequence[int]) -> AnyPair:
    """Returns how often few seeds name the wrong one of two configurations of the sweep.

    A pair surely differs where Welch's test of all seeds says so, after Bonferroni's correction
    for the number of pairs; a draw without a winner counts half.
    """
    values = MEASURES[measure].sign * MEASURES[measure].values(task)
    values = values.reshape(-1, values.shape[-1])
    first, second = np.triu_indices(len(values), 1)
    sure = _p_values(values, first, second) < LEVEL / len(first)
    first, second = first[sure], second[sure]
    truth = np.sign(values[first].mean(axis=1) - values[second].mean(axis=1))
    random = np.random.default_rng(0)
    wrong = {}
    for count in counts:
        drawn = random.integers(0, values.shape[1], (_DRAWS, len(values), count))
        means = np.take_along_axis(values[None], drawn, axis=2).mean(axis=2)
        found = np.sign(means[:, first] - means[:, second])
        wrong[count] = float(np.mean(1 - found * truth) / 2) if len(first) else float("nan")
    return AnyPair(task.name, measure, wrong, len(first))


def _p_values(values: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the p values of Welch's test of many seeds, 1 where nothing varies or differs."""
    error = values.var(axis=1, ddof=1) / values.shape[1]
    difference = values[first].mean(axis=1) - values[second].mean(axis=1)
    spread = np.sqrt(error[first] + error[second])
    t = np.divide(np.abs(difference), spread, out=np.zeros_like(spread), where=spread > 0)
    return 2 * stats.norm.sf(t)
