"""Tables of docs/seeds.md, and those beside it (CSV)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit import rows as kit
from experiments.kit.markdown import fixed, number, percent, table
from experiments.studies.seeds.answers import LEVEL, MEASURES, Contrast, Effect
from experiments.studies.seeds.few import FewSeeds
from experiments.studies.seeds.findings import Findings
from experiments.studies.seeds.runs import Task

#: Numbers of seeds in the tables of the comparisons, and of any pair.
FEW, _MANY = (3, 5, 10), (3, 5, 10, 30, 100)


def effects_table(found: Findings, contrasts: Sequence[Contrast]) -> str:
    """Returns the differences of some contrasts: a row a task, at the best rates and over all."""
    rows = []
    for contrast in contrasts:
        for task in found.tasks:
            for where in ("best", "all"):
                group = found.of(contrast, task, where)
                rates = group[0].rates
                spoken = " / ".join(map(_rates, rates)) if rates else "all settings"
                average = next(e for e in group if e.measure == "average return")
                cells = [_cell(task, effect) for effect in group]
                better = percent(average.improvement, 0) if rates else ""
                rows.append([contrast.name, task.name, spoken, *cells, better])
    header = ["", "task", "learning rates", *MEASURES, "better seed"]
    return table(header, rows)


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
        return lambda x: percent(x, 1)
    if measure == "env steps to solve":
        return lambda x: f"{fixed(x / 1000, 1)}k"
    digits = 0 if abs(task.threshold) >= 1000 else 1 if abs(task.threshold) >= 100 else 2
    return lambda x: fixed(x, digits)


def few_table(found: Findings) -> str:
    """Returns how often few seeds name the wrong arm: a row a comparison."""
    rows = []
    for x in found.few:
        cells = ["no", *("equal" for _ in FEW), ""]
        if not x.equal:
            wrong = [percent(x.wrong[n], 1) for n in FEW]
            cells = ["yes" if x.sure else "no", *wrong, number(x.needed)]
        rows.append([x.measure, x.task, x.contrast, *cells])
    header = ["by the mean", "task", "", "sure winner", *(f"{n} seeds" for n in FEW)]
    return table([*header, "seeds for 80 % power"], rows)


def pairs_table(found: Findings) -> str:
    """Returns the same of any two configurations: a row a task."""
    rows = [
        [x.measure, x.task, f"{x.pairs:,}", *(percent(x.wrong[n], 1) for n in _MANY)]
        for x in found.pairs
    ]
    header = ["by the mean", "task", "pairs", *(f"{n} seeds" for n in _MANY)]
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
    header = ["task", "untrained", "solved at", "hidden units", "env steps a run"]
    header += ["runs cut short", "runs not finite", "engine", "compiling, training"]
    return table(header, rows)


def effect_row(effect: Effect) -> dict[str, Any]:
    """Returns an effect as a row of effects.csv."""
    row = effect._asdict()
    difference, rates = row.pop("difference"), row.pop("rates") or ((), ())
    row |= {"first_learning_rate": _rates(rates[0]), "second_learning_rate": _rates(rates[1])}
    return row | {f"difference_{name}": x for name, x in difference._asdict().items()}


def wrong_rows(found: Findings) -> Iterable[dict[str, Any]]:
    """Yields the rows of wrong_winner.csv."""
    for x in (*found.few, *found.pairs):
        what = x.contrast if isinstance(x, FewSeeds) else f"any of {x.pairs} pairs"
        yield {"task": x.task, "comparison": what, "measure": x.measure} | {
            f"{count} seeds": wrong for count, wrong in x.wrong.items()
        }


def arm_rows(tasks: Sequence[Task]) -> Iterable[dict[str, Any]]:
    """Yields every configuration of the sweeps with the mean of each measure over its seeds."""
    for task in tasks:
        shape = task.final_return.shape[:-1]
        for index in np.ndindex(shape):
            settings = {
                name: values[i]
                for (name, values), i in zip(task.factors.items(), index, strict=True)
            }
            means = {name: m.values(task)[index].mean() for name, m in MEASURES.items()}
            yield {"task": task.name} | settings | means


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes rows with the same columns."""
    kit.write(path, [kit.rounded(row, 6) for row in rows])
