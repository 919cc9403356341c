"""What the seeds of one configuration say: the numbers of a row of the report."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import Configuration
from mjx_reinforce.reports.statistics import Estimate

#: So many configurations are compared pair by pair: the best.
COMPARED = 16


class Solving(NamedTuple):
    """How the seeds of a configuration reached the threshold, and whether they kept it.

    at_end, ever: how many seeds did
    rate: the share at the end, Wilson's interval
    fell: [S] who reached it and was below it at the end
    steps: [S] env steps until the first time, or all of them
    solved: [S] who ever did
    median, mean: env steps until half of the seeds have; on average, each counted up to the
      shortest training of any seed of the experiment
    """

    at_end: int
    ever: int
    rate: Estimate
    fell: np.ndarray
    steps: np.ndarray
    solved: np.ndarray
    median: Estimate
    mean: Estimate


class Result(NamedTuple):
    """What a configuration's final returns [S] say.

    final: the last evaluation of each seed, NaN where not finite
    scores: the same, with the worst finite one of the experiment in place of those
    mean, tail: of the scores; the tail is the mean of the worst tenth
    iqm: of the final returns, see ``statistics.iqm``
    band: the interquartile mean over ``Findings.grid``, arrays [K]; NaN beyond its budget
    seeds: [K, S] the curves on the grid
    areas, area: [S] the mean return over the training of each seed, which is the area under the
      seed's learning curve by the env steps, and the mean over seeds
    solving: None where the task has no threshold
    """

    configuration: Configuration
    final: np.ndarray
    scores: np.ndarray
    mean: Estimate
    tail: Estimate
    iqm: Estimate
    band: Estimate
    seeds: np.ndarray
    areas: np.ndarray
    area: Estimate
    solving: Solving | None


def shared_seeds(results: Sequence[Result]) -> np.ndarray:
    """Returns the numbers of the seeds that all configurations have, ascending."""
    return functools.reduce(np.intersect1d, [each.configuration.seed for each in results])
