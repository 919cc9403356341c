"""The page of several tasks: what it says, draws and lists."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from mjx_reinforce.reports.experiment import COMPARED, counted
from mjx_reinforce.reports.page import charts, document, learning, vega
from mjx_reinforce.reports.page.columns import Table, short
from mjx_reinforce.reports.page.figures import SHOWN, Figure, task_figures
from mjx_reinforce.reports.page.listings import Listing, listings
from mjx_reinforce.reports.page.tables import task_tables
from mjx_reinforce.reports.page.words import (
    LEVEL,
    interval_in_words,
    number,
    p_value,
    percent,
    within,
)
from mjx_reinforce.reports.tasks import Faster, Tasks, in_order

_SCORE = "A score of 0 is that of untrained policies; table 1 says what 1 is in each task."
_TASKS_METHODS = (
    "A score is (return - zero) / (one - zero), with the returns of the first table for zero and "
    "one. Seeds whose return is not finite have the worst finite return of their task.",
    "Configurations are ordered by the mean score; where means are equal, by the score of the "
    "return while training.",
    "Aggregates and their intervals are those of Agarwal et al. (2021, arXiv:2108.13264): seeds "
    "are resampled within each task.",
    "The log-rank test compares the times to solve a task, with seeds that never did as censored "
    "(Mantel 1966). Its statistics of several tasks are added and divided by the root of their "
    "number (Stouffer et al. 1949); p values are corrected after Holm (1979).",
)


class TaskSection(NamedTuple):
    """One task on the page: its charts, and where the page of the task alone lies."""

    env: str
    page: str
    href: str
    curves: Figure
    solved: Figure | None


def labels(tasks: Tasks) -> list[str]:
    """Returns the names of the configurations, best first."""
    return [each.label for each in tasks.overall]


def tasks_figures(tasks: Tasks) -> list[Figure]:
    """Returns the scores over all tasks, and each task's curves, numbered."""
    names = labels(tasks)
    title = "mean score over tasks"
    chart = charts.final(names, 1.0 if all(s.solved for s in tasks.scales) else None, title)
    best = tasks.overall[0]
    alt = (
        f"{counted(len(names), 'row')}, best first. The best, {best.label}, is at "
        f"{number(float(best.mean.value))}, {within(best.mean)}."
    )
    spec = vega.specification(chart, names, names[:SHOWN], 0.0, 0) | {"description": alt}
    caption = (
        "Points are means over tasks of the means over seeds, thick lines their 95 % intervals, "
        "and pale bars the middle eight tenths of all seeds."
    )
    made = [Figure("overall", 1, "The scores at the end", caption, alt, spec, ["final"])]
    for n, findings in enumerate(tasks.findings):
        made += task_figures(in_order(tasks, findings), n, len(made) + 1)
    return made


def tasks_chart_tables(tasks: Tasks) -> dict[str, Table]:
    """Returns the data of the charts by name."""
    every = [np.concatenate(each.scores) for each in tasks.overall]
    spread = [np.quantile(each, [0.1, 0.9]) for each in every]
    found: dict[str, Table] = {
        "final": {
            "configuration": list(range(len(every))),
            "place": list(range(len(every))),
            "value": short([each.mean.value for each in tasks.overall]),
            "low": short([each.mean.low for each in tasks.overall]),
            "high": short([each.mean.high for each in tasks.overall]),
            "tenth": short([low for low, _ in spread]),
            "ninetieth": short([high for _, high in spread]),
        }
    }
    for n, findings in enumerate(tasks.findings):
        drawn = task_tables(in_order(tasks, findings))
        found |= {f"{name}-{n}": table for name, table in drawn.items()}
    return found


def listed(tasks: Tasks) -> dict[str, Listing]:
    """Returns the tables by name, in the order of the page."""
    found = {"scales": _scales(tasks), "overall": _overall_table(tasks)}
    if tasks.faster:
        found["faster"] = _faster_table(tasks)
    for n, findings in enumerate(tasks.findings):
        alone = listings(findings)
        found |= {f"{name}-{n}": alone[name] for name in ("results", "speed") if name in alone}
    return found


def _scales(tasks: Tasks) -> Listing:
    rows = []
    for findings, scale in zip(tasks.findings, tasks.scales, strict=True):
        one = "counts as solved" if scale.solved else "the greatest mean here"
        cells = [(number(scale.zero), "untrained policies"), (number(scale.one), one)]
        rows.append({"label": findings.experiment.env, "cells": cells})
    return {"header": ["task", "score 0 is a return of", "score 1 is a return of"], "rows": rows}


def _overall_table(tasks: Tasks) -> Listing:
    solving = any(each.seeds for each in tasks.overall)
    header = ["", "configuration", "seeds", "mean score", "interquartile mean", "while training"]
    rows = []
    for each in tasks.overall:
        cells = [(f"{sum(map(len, each.scores)):,}", "")]
        for estimate in (each.mean, each.iqm, each.area):
            cells.append((number(float(estimate.value)), interval_in_words(estimate)))
        if solving:
            cells.append((f"{each.solved:,} of {each.seeds:,}", percent(each.solved / each.seeds)))
        rows.append({"label": each.label, "cells": cells})
    return {"header": header + ["solved at the end"] * solving, "rows": rows}


def _faster_table(tasks: Tasks) -> Listing:
    names = labels(tasks)
    tested = [e.experiment.env for e in tasks.findings if e.experiment.threshold is not None]
    rows = []
    for each in tasks.faster:
        cells = []
        for statistic in each.statistics:
            p = 2 * float(stats.norm.sf(abs(statistic)))
            cells.append((learning.short_p(p), _sooner(names, each, statistic)))
        cells.append((learning.short_p(each.p_value), _sooner(names, each, sum(each.statistics))))
        cells.append((learning.short_p(each.adjusted), ""))
        rows.append({"label": f"{names[each.first]} or {names[each.second]}", "cells": cells})
    return {"header": ["pair", *tested, "all tasks", "all, Holm"], "rows": rows}


def _sooner(names: list[str], pair: Faster, statistic: float) -> str:
    """Returns the faster configuration of a pair by its name."""
    if not statistic:
        return "equal"
    return names[pair.first if statistic > 0 else pair.second]


def tasks_answer(tasks: Tasks) -> list[str]:
    """Returns the answer in a few sentences; the speed first, where the best scores are equal."""
    best = tasks.overall[0]
    envs = counted(len(tasks.findings), "task")
    mean = f"{number(float(best.mean.value))} ({within(best.mean)})"
    if len(tasks.overall) == 1:
        return [f"Over {envs}, the mean score is {mean}.", _SCORE]
    second = tasks.overall[1]
    next_mean = f"{number(float(second.mean.value))} ({within(second.mean)})"
    said = [
        f"Over {envs}, the greatest mean score is that of {best.label}: {mean}.",
        f"The next is {second.label}: {next_mean}. {_SCORE}",
    ]
    speed = list(_who_is_faster(tasks))
    said = [*speed, *said] if mean == next_mean else [*said, *speed]
    return [*said, *_of_tasks(tasks)]


def _who_is_faster(tasks: Tasks) -> Iterator[str]:
    """Yields who is faster over all tasks."""
    if not tasks.faster:
        return
    names, number_of = labels(tasks), len(tasks.overall)
    wins = dict.fromkeys(range(number_of), 0)
    for each in tasks.faster:
        wins[each.first if sum(each.statistics) > 0 else each.second] += 1
    first = max(wins, key=lambda i: wins[i])
    own = [each for each in tasks.faster if first in (each.first, each.second)]
    slower = {
        each.first + each.second - first: each.adjusted
        for each in own
        if each.adjusted < LEVEL and _sooner(names, each, sum(each.statistics)) == names[first]
    }
    if not slower:
        yield "By the log-rank tests of all tasks together, no configuration is surely the fastest."
        return
    worst = p_value(max(slower.values()))
    bound = " or less" if len(slower) > 1 and not worst.startswith("p <") else ""
    how = f"{worst}{bound} after Holm's correction for {counted(len(tasks.faster), 'pair')}"
    if len(slower) == len(own):
        yield (
            f"The tasks are solved soonest by {names[first]}: sooner than by "
            f"{'the other' if len(own) == 1 else 'any other'}, by the log-rank tests of all tasks "
            f"together ({how})."
        )
    else:
        said = learning.faster([names[i] for i in sorted(slower)])
        yield (
            f"By the log-rank tests of all tasks together, {names[first]} is {said} ({how}), and "
            "no configuration is surely the fastest of all."
        )


def _of_tasks(tasks: Tasks) -> Iterator[str]:
    for findings in tasks.findings:
        env = findings.experiment.env
        first, slower = learning.pace(findings)
        if len(slower) == len(findings.results[:COMPARED]) - 1 > 0:
            yield f"In {env}, the fastest is surely {first}."
        elif slower:
            yield f"In {env}, {first} is surely {learning.faster(slower)}."
        elif findings.learning.speeds:
            yield f"In {env}, no configuration is surely the fastest of all."


def tasks_caveats(tasks: Tasks) -> list[str]:
    """Returns what to distrust, the gravest first."""
    said = []
    for findings in tasks.findings:
        experiment = findings.experiment
        said += [
            f"{each} is not finished: these are its results." for each in experiment.unfinished
        ]
    if tasks.left_out:
        names = "; ".join(tasks.left_out[:4]) + ("; ..." if len(tasks.left_out) > 4 else "")
        said.append(f"Not every task has these configurations, which are left out: {names}.")
    if any(not scale.solved for scale in tasks.scales):
        said.append(
            "Where no return counts as solved, the score 1 is the greatest mean return here. Such "
            "scores cannot be compared with those of another report."
        )
    said.append(
        f"{counted(len(tasks.findings), 'task')}: the intervals are of other seeds on the same "
        "tasks, and say nothing of another task."
    )
    if len(tasks.overall) > 1:
        said.append("The best was chosen by the same seeds that give its figures.")
    return said


def render_tasks(
    tasks: Tasks,
    drawn: list[Figure],
    data: Mapping[str, Table],
    files: Mapping[str, str],
    pages: list[tuple[str, str]],
    version: str,
    seconds: float,
) -> str:
    """Returns the page; ``pages`` are the name and the address of each task's own page."""
    by_name = {figure.name: figure for figure in drawn}
    parts = [
        TaskSection(e.experiment.env, *page, by_name[f"curves-{n}"], by_name.get(f"solved-{n}"))
        for n, (e, page) in enumerate(zip(tasks.findings, pages, strict=True))
    ]
    envs = [part.env for part in parts]
    contents = [("answer", "Answer"), ("overall", "All tasks"), ("curves", "Learning curves")]
    contents += [(f"task-{n}", env) for n, env in enumerate(envs)]
    tables = listed(tasks)
    content = {
        "labels": labels(tasks),
        "specs": {figure.name: figure.spec for figure in drawn},
        "tables": {**data, **vega.ONE},
        "moments": [0],
        "files": files,
    }
    facts = [
        (f"{e.experiment.env}, {name}", value)
        for e in tasks.findings
        for name, value in document.provenance_rows(e.experiment)["facts"]
    ]
    return document.fill(
        "tasks.html",
        content,
        title=f"{counted(len(envs), 'task')}, {counted(len(tasks.overall), 'configuration')}",
        asked=f"Which configuration does best, and learns fastest, over {', '.join(envs)}?",
        contents=[*contents, ("source", "Where this comes from"), ("data", "Data")],
        answer=tasks_answer(tasks),
        distrust=tasks_caveats(tasks),
        figures={"overall": by_name["overall"]},
        labels=labels(tasks),
        first_shown=SHOWN,
        listed=tables,
        numbers={name: place for place, name in enumerate(tables, start=1)},
        tasks=parts,
        facts=facts,
        methods=_TASKS_METHODS,
        version=version,
        seconds=seconds,
    )
