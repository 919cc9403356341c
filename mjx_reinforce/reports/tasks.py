"""Several tasks in one report: normalized scores, aggregates over tasks, speed over tasks."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import Experiment, Result, relabel
from mjx_reinforce.reports.findings import Findings, compute_findings
from mjx_reinforce.reports.statistics import Estimate
from mjx_reinforce.reports.statistics.aggregates import interval
from mjx_reinforce.reports.statistics.comparisons import holm
from mjx_reinforce.reports.statistics.survival import combined, log_rank


class Scale(NamedTuple):
    """Which returns of a task are the scores 0 and 1.

    zero: the mean return of the untrained policies
    one: the return that counts as solved, or the greatest mean return at the end
    solved: whether it is the former
    """

    zero: float
    one: float
    solved: bool


class Overall(NamedTuple):
    """A configuration over all tasks, by normalized scores.

    scores, areas: of the tasks, [S] each: the last return, and the mean return while training
    mean: over tasks of the mean over seeds, with the stratified bootstrap's interval
    iqm, area: interquartile means of the scores, and of the areas, over all seeds and tasks
    solved, seeds: how many seeds solve their task at the end, and of how many
    """

    label: str
    scores: list[np.ndarray]
    areas: list[np.ndarray]
    mean: Estimate
    iqm: Estimate
    area: Estimate
    solved: int
    seeds: int


class Faster(NamedTuple):
    """The log-rank tests of two configurations, ``first`` and ``second`` being their places.

    statistics: of each task with a threshold, above 0 where the first solves it sooner
    p_value: of all tasks together
    adjusted: the same after Holm's correction for all pairs
    """

    first: int
    second: int
    statistics: list[float]
    p_value: float
    adjusted: float


class Tasks(NamedTuple):
    """All figures of a report of several tasks.

    findings: of each task
    scales: of each task
    overall: best first, by the mean score, or where that is the same, by the area
    faster: of all pairs; empty where no task has a threshold
    left_out: the configurations that not all tasks have
    """

    findings: list[Findings]
    scales: list[Scale]
    overall: list[Overall]
    faster: list[Faster]
    left_out: list[str]


def rename(experiments: Sequence[Experiment], labels: Mapping[str, str]) -> list[Experiment]:
    """Returns experiments whose configurations have other names, see ``experiment.relabel``.

    Where each task has a single configuration, that has the same name in all.

    Raises:
      ValueError: an old name is of no configuration of any task, or names are no longer different.
    """
    everywhere = {part.label for each in experiments for part in each.configurations}
    for label in labels.keys() - everywhere:
        relabel(experiments[0], {label: ""})
    renamed = []
    for each in experiments:
        known = {part.label for part in each.configurations}
        alone = {next(iter(known)): "the settings of each task"} if len(known) == 1 else {}
        single = alone if all(len(e.configurations) == 1 for e in experiments) else {}
        renamed.append(relabel(each, single | {k: v for k, v in labels.items() if k in known}))
    return renamed


def find_tasks(experiments: Sequence[Experiment]) -> Tasks:
    """Computes all figures of a report of several tasks.

    Raises:
      ValueError: no configuration is of all tasks, or a task has no scale.
    """
    names = [[part.label for part in each.configurations] for each in experiments]
    shared = [label for label in names[0] if all(label in some for some in names)]
    if not shared:
        pairs = zip(experiments, names, strict=True)
        listed = "; ".join(f"{each.env}: {', '.join(some[:3])}" for each, some in pairs)
        raise ValueError(
            f"the tasks have no configuration in common ({listed}); name those that belong "
            "together alike with --labels OLD=NEW"
        )
    found = [compute_findings(_only(each, shared)) for each in experiments]
    scales = [scale(each) for each in found]
    overall = [_overall(label, found, scales) for label in shared]
    overall.sort(key=lambda each: (-_or_least(each.mean), -_or_least(each.area)))
    left_out = [label for some in names for label in some if label not in shared]
    return Tasks(found, scales, overall, _faster(found, overall), list(dict.fromkeys(left_out)))


def in_order(tasks: Tasks, findings: Findings) -> Findings:
    """Returns a task's figures with the results in the order of ``Tasks.overall``, for charts."""
    places = {each.label: i for i, each in enumerate(tasks.overall)}
    results = sorted(findings.results, key=lambda r: places[r.configuration.label])
    return findings._replace(results=results)


def scale(findings: Findings) -> Scale:
    """Returns the scale of a task.

    Raises:
      ValueError: 1 would not be above 0: it is solved without training, or nothing is learned.
    """
    experiment = findings.experiment
    first = np.concatenate([part.eval_return[0] for part in experiment.configurations])
    zero = float(np.mean(first[np.isfinite(first)])) if np.isfinite(first).any() else math.nan
    solved = experiment.threshold is not None
    one = experiment.threshold if solved else max(_or_least(each.mean) for each in findings.results)
    if not (one is not None and one > zero):
        raise ValueError(
            f"{experiment.env} has no normalized score: untrained policies return {zero:.4g}, and "
            f"{'solved is' if solved else 'the best configuration returns'} {one:.4g}; leave it out"
        )
    return Scale(zero, one, solved)


def _only(experiment: Experiment, labels: Sequence[str]) -> Experiment:
    """Returns an experiment with the configurations of some names."""
    kept = [i for i, part in enumerate(experiment.configurations) if part.label in labels]
    return experiment._replace(
        configurations=[experiment.configurations[i] for i in kept],
        directories=[experiment.directories[i] for i in kept],
    )


def _of(findings: Findings, label: str) -> Result:
    return next(each for each in findings.results if each.configuration.label == label)


def _overall(label: str, found: Sequence[Findings], scales: Sequence[Scale]) -> Overall:
    results = [_of(each, label) for each in found]
    scores, areas = (
        [(getattr(r, n) - s.zero) / (s.one - s.zero) for r, s in zip(results, scales, strict=True)]
        for n in ("scores", "areas")
    )
    strata = np.repeat(np.arange(len(found)), [len(each) for each in scores])
    solving = [each.solving for each in results if each.solving is not None]
    return Overall(
        label=label,
        scores=scores,
        areas=areas,
        mean=interval("mean", np.concatenate(scores), strata=strata),
        iqm=interval("iqm", np.concatenate(scores), strata=strata),
        area=interval("iqm", np.concatenate(areas), strata=strata),
        solved=sum(each.at_end for each in solving),
        seeds=sum(len(each.solved) for each in solving),
    )


def _faster(found: Sequence[Findings], overall: Sequence[Overall]) -> list[Faster]:
    """Tests all pairs in the tasks that have a threshold."""
    solving = [
        [solving for each in overall if (solving := _of(findings, each.label).solving)]
        for findings in found
        if findings.experiment.threshold is not None
    ]
    if not solving:
        return []
    pairs = list(itertools.combinations(range(len(solving[0])), 2))
    tests = [
        [log_rank(a[i].steps, a[i].solved, a[j].steps, a[j].solved).statistic for a in solving]
        for i, j in pairs
    ]
    p_values = [combined(each) for each in tests]
    return [
        Faster(i, j, each, p_value, float(adjusted))
        for (i, j), each, p_value, adjusted in zip(
            pairs, tests, p_values, holm(p_values), strict=True
        )
    ]


def _or_least(estimate: Estimate) -> float:
    value = float(estimate.value)
    return -math.inf if math.isnan(value) else value
