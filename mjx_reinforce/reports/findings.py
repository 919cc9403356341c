"""The figures of a report: what an experiment's numbers say, best configuration first."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import Configuration, Experiment
from mjx_reinforce.statistics import Estimate, cvar, estimate_mean, iqm, iqm_interval, wilson
from mjx_reinforce.statistics.comparisons import Comparison, compare_all, holm
from mjx_reinforce.statistics.survival import (
    collapses,
    log_rank,
    mean_while_training,
    median_steps,
    restricted_mean,
    time_to_threshold,
)
from mjx_reinforce.statistics.tolerance import lower_tolerance

#: So many configurations are compared pair by pair: the best.
COMPARED = 16
#: Env steps at which curves are read off.
_GRID_POINTS = 60
#: Ends that are so close are those of one budget.
_SAME_BUDGET = 0.9
#: How many of the worst seeds are named, and what share of all, at most.
_WORST = 10
_WORST_SHARE = 0.25


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
    floor: what at least 90% of all runs return, with 95% confidence; NaN of too few seeds
    drops: [S] how far each seed ended below its best evaluation
    iqm: of the final returns, see ``statistics.iqm``
    band: the interquartile mean over ``Findings.grid``, arrays [K]; NaN beyond its budget
    seeds: [K, S] the curves on the grid
    area: of each seed's mean return over its training, the area under its learning curve
    solving: None where the task has no threshold
    """

    configuration: Configuration
    final: np.ndarray
    scores: np.ndarray
    mean: Estimate
    tail: float
    floor: float
    drops: np.ndarray
    iqm: Estimate
    band: Estimate
    seeds: np.ndarray
    area: Estimate
    solving: Solving | None


class Findings(NamedTuple):
    """All figures of a report.

    results: best first, see ``_rank``; behind all others what a sweep excluded while it went on
    order: of each result, the place of its configuration in the experiment
    grid: [K] env steps
    comparisons: of all pairs of the best results, which are numbered by their places here
    speeds: p values of equal times to solve of the same pairs, see ``compare_speeds``
    until: env steps at which areas end and the mean env steps to solve are cut off
    """

    experiment: Experiment
    results: list[Result]
    order: list[int]
    grid: np.ndarray
    comparisons: list[Comparison]
    speeds: dict[tuple[int, int], float]
    until: int

    @property
    def intervals(self) -> bool:
        """Whether the mean of any configuration has an interval."""
        return any(math.isfinite(result.mean.low) for result in self.results)

    @property
    def labels(self) -> list[str]:
        """The names of the configurations, the best first."""
        return [result.configuration.label for result in self.results]


def compute_findings(experiment: Experiment) -> Findings:
    """Computes all figures of a report."""
    parts = experiment.configurations
    ends = [int(part.env_steps[-1].min()) for part in parts]
    # A seed stops after the update that reaches its budget, so that ends differ a little.
    grid = _curve_steps(parts, min(end for end in ends if end >= _SAME_BUDGET * max(ends)))
    finals = np.concatenate([part.eval_return[-1] for part in parts])
    # Of all configurations: a seed that failed is then as bad in one as in another.
    worst_return = min(finals[np.isfinite(finals)], default=math.nan)
    results = [
        _result(part, grid, worst_return, _solving_of(part, experiment, min(ends)), min(ends))
        for part in parts
    ]
    # From here on a configuration is known by its rank; ``order`` leads back to the sources.
    contenders = range(len(results))
    if experiment.decision is not None:
        contenders = experiment.decision.contenders
    order = sorted(range(len(results)), key=lambda i: (i not in contenders, *_rank(results[i])))
    ranked_results = [results[i] for i in order]
    return Findings(
        experiment,
        results=ranked_results,
        order=order,
        grid=grid,
        comparisons=_compare_pairs(ranked_results[:COMPARED]),
        speeds=compare_speeds(ranked_results[:COMPARED]),
        until=min(ends),
    )


def on_grid(grid: np.ndarray, steps: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Returns curves [E, S] read off, by linear interpolation, on a grid [K] of steps: [K, S].

    A return that is not finite makes all that is read off beside it so, too.
    """
    curves = []
    for s in range(returns.shape[1]):
        has_moved = np.diff(steps[:, s], prepend=-1) > 0  # a seed that stands still keeps its value
        curves.append(np.interp(grid, steps[has_moved, s], returns[has_moved, s]))
    return np.stack(curves, axis=1)


def _curve_steps(parts: Sequence[Configuration], end: int) -> np.ndarray:
    """Returns env steps from 0 to the end: evenly, and with more at the start for a log axis."""
    # The first evaluation is that before training, at 0, and the second is the first to learn from.
    first_steps = min(int(part.env_steps[min(1, len(part.env_steps) - 1)].max()) for part in parts)
    even_steps = np.linspace(0, end, _GRID_POINTS - 12)
    early_steps = np.geomspace(max(first_steps, 1), max(end, 2), 14)[:-1]
    return np.unique(np.concatenate([even_steps, early_steps[early_steps < end]]).round())


def _result(
    part: Configuration, grid: np.ndarray, worst: float, solving: Solving | None, until: int
) -> Result:
    """Returns the figures of a configuration.

    Args:
      part: the configuration.
      grid: [K] env steps at which curves are read off.
      worst: the return of a seed that failed.
      solving: its figures of the threshold, if there is one.
      until: env steps at which areas end.
    """
    final = part.eval_return[-1]
    seeds = on_grid(grid, part.env_steps, part.eval_return)
    # Interpolation would hold the last value where a curve has ended.
    end = part.env_steps[-1].min()
    seeds = np.where((grid <= end)[:, None], seeds, np.nan)
    scores = np.where(np.isfinite(final), final, worst)
    finite_returns = np.where(np.isfinite(part.eval_return), part.eval_return, worst)
    areas = mean_while_training(finite_returns, part.env_steps, until)
    return Result(
        configuration=part,
        final=final,
        scores=scores,
        mean=estimate_mean(scores),
        tail=float(cvar(scores)),
        floor=lower_tolerance(final),
        drops=finite_returns.max(axis=0) - scores,
        iqm=Estimate(iqm(final), *iqm_interval(final)),
        band=Estimate(iqm(seeds), *iqm_interval(seeds)),
        seeds=seeds,
        area=estimate_mean(areas),
        solving=solving,
    )


def _solving_of(part: Configuration, experiment: Experiment, until: int) -> Solving | None:
    """Returns the figures of the threshold, of env steps up to ``until``; None without one."""
    threshold = experiment.threshold
    if threshold is None:
        return None
    returns = part.eval_return
    steps, solved = time_to_threshold(returns, part.env_steps, threshold)
    at_end = int(np.sum(returns[-1] >= threshold))
    return Solving(
        at_end=at_end,
        ever=int(solved.sum()),
        rate=wilson(at_end, returns.shape[1]),
        fell=collapses(returns, threshold),
        steps=steps,
        solved=solved,
        median=median_steps(steps, solved),
        mean=restricted_mean(steps, solved, until),
    )


def _rank(result: Result) -> tuple[float, ...]:
    """Returns the sorting key of a result: its mean, and where that is the same, its speed."""
    speed = float(result.solving.mean.value) if result.solving else 0.0
    mean = float(result.mean.value)
    # NaN compares as neither less nor more, and would leave the others in any order: it is last.
    return tuple(math.inf if math.isnan(value) else value for value in (-mean, speed))


def _compare_pairs(results: Sequence[Result]) -> list[Comparison]:
    """Compares the scores of all pairs, each on the seeds that both have."""
    seeds = [result.configuration.seed for result in results]
    pairs = itertools.combinations(seeds, 2)
    if min((np.intersect1d(*pair).size for pair in pairs), default=0) < 2:
        return []
    return compare_all([result.scores for result in results], seeds)


def by_speed(results: Sequence[Result]) -> list[int]:
    """Returns the places of results by their mean env steps to solve, the fewest first."""
    means = [float(result.solving.mean.value) for result in results if result.solving is not None]
    return np.argsort(means, kind="stable").tolist()


def compare_speeds(results: Sequence[Result]) -> dict[tuple[int, int], float]:
    """Returns the p values of the log-rank test of all pairs, by their places, after Holm.

    There are none where no seed solves the task.
    """
    solving = [result.solving for result in results if result.solving is not None]
    if not any(figures.ever for figures in solving):
        return {}
    pairs = list(itertools.combinations(range(len(solving)), 2))
    p_values = [
        log_rank(solving[i].steps, solving[i].solved, solving[j].steps, solving[j].solved).p_value
        for i, j in pairs
    ]
    return dict(zip(pairs, holm(p_values).tolist(), strict=True))


def lost_by_lot(findings: Findings) -> float:
    """Returns what share of the best's gain a configuration drawn by lot lacks, on average.

    A gain is from the mean return before training to that of a configuration at the end. NaN where
    the best gains nothing.
    """
    starts = [result.configuration.eval_return[0] for result in findings.results]
    start = np.nanmean(np.concatenate(starts))
    gains = np.array([result.mean.value for result in findings.results]) - start
    return float(1 - gains.mean() / gains[0]) if gains[0] > 0 else math.nan


def swept(findings: Findings) -> list[str]:
    """Returns the settings of which configurations differ."""
    if len(findings.results) == 1:
        return []
    return list(findings.results[0].configuration.settings)


def values_of(findings: Findings, name: str) -> list[Any]:
    """Returns the value of a setting in each result."""
    return [result.configuration.settings.get(name) for result in findings.results]


def worst_seeds(result: Result) -> np.ndarray:
    """Returns the places of the worst seeds of a configuration, the worst first: at least one."""
    return from_the_worst(result)[: min(_WORST, math.ceil(_WORST_SHARE * len(result.final)))]


def from_the_worst(result: Result) -> np.ndarray:
    """Returns the places of all seeds, ordered by the return at the end; not finite is worst."""
    return np.argsort(np.nan_to_num(result.final, nan=-np.inf), kind="stable")
