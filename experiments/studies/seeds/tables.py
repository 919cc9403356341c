"""The tables of docs/seeds.md."""

from collections.abc import Callable, Sequence

import numpy as np

from experiments.kit.markdown import fixed, number, percent, table
from experiments.studies.seeds.answers import CONTRASTS, LEVEL, MEASURES, Effect
from experiments.studies.seeds.few import AnyPair, FewSeeds
from experiments.studies.seeds.runs import Task

#: Numbers of seeds in the table of the comparisons.
FEW = (3, 5, 10)


def effects_table(tasks: Sequence[Task], effects: Sequence[Effect]) -> str:
    """Returns all differences: two rows a task, at the best rates and over all settings."""
    rows = []
    for contrast in CONTRASTS:
        for task in tasks:
            for where in ("best", "all"):
                wanted = (task.name, contrast.name, where)
                group = [e for e in effects if (e.task, e.contrast, e.where) == wanted]
                rates = group[0].rates
                spoken = " / ".join(map(_rates, rates)) if rates else "all settings"
                average = next(e for e in group if e.measure == "average return")
                better = percent(average.improvement, 0, "") if rates else ""
                cells = [_cell(task, effect) for effect in group]
                rows.append([contrast.name, task.name, spoken, *cells, better])
    return table(["", "task", "learning rates", *MEASURES, "better seed (%)"], rows)


def _rates(rates: Sequence[float]) -> str:
    """Returns the learning rates of an arm: "0.01", or "0.003 or 0.01"."""
    return " or ".join(f"{rate:g}" for rate in rates)


def _cell(task: Task, effect: Effect) -> str:
    """Returns both values, and the difference with its interval; bold where it is sure."""
    show = _shower(task, effect.measure)
    mark = "**" if effect.adjusted < LEVEL else ""
    value, low, high, _ = effect.difference
    signed = f"{'+' if value > 0 and show(value) != show(0.0) else ''}{show(value)}"
    return (
        f"{show(effect.first)} / {show(effect.second)}: "
        f"{mark}{signed}{mark} ({show(low)}, {show(high)})"
    )


def _shower(task: Task, measure: str) -> Callable[[float], str]:
    """Returns what writes a value of a measure for people."""
    if measure == "solved at the end":
        return lambda x: percent(x, 1, "")
    if measure == "env steps to solve":
        return lambda x: f"{fixed(x / 1000, 1)}k"
    digits = 0 if abs(task.threshold) >= 1000 else 1 if abs(task.threshold) >= 100 else 2
    return lambda x: fixed(x, digits)


def few_table(found: Sequence[FewSeeds]) -> str:
    """Returns how often few seeds name the wrong arm: a row a comparison."""
    rows = []
    for x in found:
        cells = ["no", *("equal" for _ in FEW), ""]
        if not x.equal:
            wrong = [percent(x.wrong[n], 1, "") for n in FEW]
            cells = ["yes" if x.sure else "no", *wrong, number(x.needed)]
        rows.append([x.measure, x.task, x.contrast, *cells])
    header = ["by the mean", "task", "", "sure winner", *(f"{n} seeds (%)" for n in FEW)]
    return table([*header, "seeds for 80% power"], rows)


def pairs_table(found: Sequence[AnyPair]) -> str:
    """Returns the same of any two configurations: a row a task."""
    rows = [
        [x.measure, x.task, f"{x.pairs:,}", *(percent(x.wrong[n], 1, "") for n in x.wrong)]
        for x in found
    ]
    header = ["by the mean", "task", "pairs", *(f"{n} seeds (%)" for n in found[0].wrong)]
    return table(header, rows)


def task_table(tasks: Sequence[Task]) -> str:
    """Returns what each task was, and how its runs went."""
    rows = []
    for task in tasks:
        record, settings = task.record, task.record["settings"]
        units = " and ".join(map(str, settings["hidden_sizes"])) or "none (linear)"
        cut = float(np.mean(task.env_steps < task.budget))
        time = f"{record['compile_seconds']:.0f} s, {record['run_seconds']:.0f} s"
        rows.append(
            [
                *(task.name, f"{task.untrained:,.0f}", f"{task.threshold:,g}", units),
                *(f"{task.budget:,}", percent(cut, 1), f"{record['nonfinite_runs']:,}"),
                *(record["engine"], time),
            ]
        )
    header = ["task", "untrained", "solved at", "hidden units", "env steps per run"]
    header += ["runs cut short", "runs not finite", "engine", "compiling, training"]
    return table(header, rows)
