"""Configurations over several tasks: scores that tasks share, and what they say of the best."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.experiment import race_in_words
from mjx_reinforce.reports.findings import Findings, Result
from mjx_reinforce.statistics import Estimate
from mjx_reinforce.statistics.tasks import iqm_of_tasks, mean_of_tasks, performance_profile

#: Scores at which profiles are read off.
_POINTS = 101
#: What runs are called of which each task has one configuration.
_LONE_LABEL = "all runs"


class Scale(NamedTuple):
    """The returns of a task whose scores are 0 and 1.

    zero: the mean of the untrained policies
    one: the return that counts as solved, or else the greatest mean at the end
    """

    zero: float
    one: float


class Standing(NamedTuple):
    """A configuration over all tasks.

    scores: [S] of each task
    mean, iqm: of the scores, see ``statistics.tasks``
    behind: how much lower its mean is than the best's, on the seeds that both have
    profile: arrays [T], the share of runs above each of ``TaskFindings.thresholds``
    """

    label: str
    scores: list[np.ndarray]
    mean: Estimate
    iqm: Estimate
    behind: Estimate
    profile: Estimate


class TaskFindings(NamedTuple):
    """All figures of a report on several tasks.

    tasks, scales: of each task
    standings: of the configurations that all tasks have, best first
    thresholds: [T] scores
    gain_by_tuning: how much higher the mean is with each task's own best configuration than with
      the best for all tasks: the sensitivity to settings of Adkins et al. (2024, arXiv:2412.07165)
    """

    tasks: list[Findings]
    scales: list[Scale]
    standings: list[Standing]
    thresholds: np.ndarray
    gain_by_tuning: float


def compare_tasks(tasks: Sequence[Findings]) -> TaskFindings:
    """Computes all figures of a report on several tasks.

    Raises:
      ValueError: no configuration is in all of them, or nothing was learned in one.
    """
    results = [_by_label(findings, lone=_are_lone(tasks)) for findings in tasks]
    labels = [label for label in results[0] if all(label in task for task in results)]
    if not labels:
        names = ", ".join(findings.experiment.env for findings in tasks)
        raise ValueError(
            f"no configuration is in all tasks ({names}): sweep the same values in each, or report "
            "on each by itself"
        )
    scales = [_scale(findings) for findings in tasks]
    scores = {
        label: [
            (task[label].scores - scale.zero) / (scale.one - scale.zero)
            for task, scale in zip(results, scales, strict=True)
        ]
        for label in labels
    }
    means = {label: np.array([part.mean() for part in parts]) for label, parts in scores.items()}
    labels.sort(key=lambda label: -means[label].mean())
    highest = max(part.max() for parts in scores.values() for part in parts)
    thresholds = np.linspace(0, max(1.0, highest), _POINTS)
    standings = []
    for label in labels:
        differences = []
        for task, best_scores, own_scores in zip(
            results, scores[labels[0]], scores[label], strict=True
        ):
            best_seeds, seeds = (task[name].configuration.seed for name in (labels[0], label))
            shared = np.isin(best_seeds, seeds), np.isin(seeds, best_seeds)
            differences.append(best_scores[shared[0]] - own_scores[shared[1]])
        standings.append(
            Standing(
                label,
                scores[label],
                mean=mean_of_tasks(scores[label]),
                iqm=iqm_of_tasks(scores[label]),
                behind=mean_of_tasks(differences),
                profile=performance_profile(scores[label], thresholds),
            )
        )
    tuned = np.max([means[label] for label in labels], axis=0)
    gain_by_tuning = float(tuned.mean() - means[labels[0]].mean())
    return TaskFindings([*tasks], scales, standings, thresholds, gain_by_tuning)


def _are_lone(tasks: Sequence[Findings]) -> bool:
    return all(len(findings.results) == 1 for findings in tasks)


def _by_label(findings: Findings, *, lone: bool) -> dict[str, Result]:
    """Returns the results of a task by their labels; a lone one is called by its task there."""
    if lone:
        label = _LONE_LABEL + race_in_words(findings.experiment.settings)
        return {label: findings.results[0]}
    return dict(zip(findings.labels, findings.results, strict=True))


def _scale(findings: Findings) -> Scale:
    """Returns the scale of a task, or raises ValueError where nothing was learned."""
    starts = [result.configuration.eval_return[0] for result in findings.results]
    zero = float(np.nanmean(np.concatenate(starts)))
    threshold = findings.experiment.threshold
    one = max(float(result.mean.value) for result in findings.results)
    if threshold is not None:
        one = threshold
    if not zero < one:
        raise ValueError(
            f"{findings.experiment.env} has no scores: its untrained policies return {zero:g}, and "
            f"{one:g} would be 1; leave it out"
        )
    return Scale(zero, one)


def draw_profile(findings: TaskFindings) -> charts.Chart:
    """Returns the chart of the share of runs above each score."""
    labels = [standing.label for standing in findings.standings]
    table = charts.stacked(
        {
            "configuration": place,
            "score": charts.short(findings.thresholds),
            "share": charts.short(standing.profile.value),
            "low": charts.short(standing.profile.low),
            "high": charts.short(standing.profile.high),
        }
        for place, standing in enumerate(findings.standings)
    )
    title = "runs above the score"
    share = charts.quantity("share", title=title, scale={"domain": [0, 1]}, axis={"format": ".0%"})
    band = {"y": charts.quantity("low", title=title), "y2": {"field": "high"}}
    line = {"y": share, "strokeDash": charts.dashes(labels)}
    interval = ", with pointwise 95% intervals" if charts.has_width(table) else ""
    alt = "Share of runs over the score, a falling line for each configuration."
    spec = {
        "$schema": "https://vega.github.io/schema/vega-lite/v6.json",
        "description": alt,
        "config": charts.CONFIG,
        "params": [{"name": "shown", "value": labels}],
        "height": 320,
        "data": {"name": "profile"},
        "encoding": {
            "x": charts.quantity("score", title="score"),
            "color": charts.series(labels),
        },
        "layer": [
            charts.layer("area", band, opacity=0.18),
            charts.layer("line", line, strokeWidth=2.2),
        ],
    }
    return charts.Chart(
        name="profile",
        title="Performance profile",
        caption=(
            f"The share of runs above each score, the mean of the tasks' shares{interval} (Agarwal "
            "et al. 2021). A line that is above another everywhere is better at every score."
        ),
        alt=alt,
        spec=spec,
        data={"profile": table},
        number=1,
    )


def score_rows(findings: TaskFindings) -> list[list[Any]]:
    """Returns a row for each task, configuration and score, below a header."""
    rows: list[list[Any]] = [["task", "configuration", "score"]]
    for standing in findings.standings:
        for task, scores in zip(findings.tasks, standing.scores, strict=True):
            env = task.experiment.env
            rows += [[env, standing.label, score] for score in charts.short(scores, 7)]
    return rows
