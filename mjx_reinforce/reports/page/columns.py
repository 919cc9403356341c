"""Tables by columns, as the page embeds them, and as CSV files."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mjx_reinforce.files import csv_text
from mjx_reinforce.reports.experiment import say
from mjx_reinforce.reports.findings import Findings, swept

#: Columns by name, all of one length. ``configuration`` holds places among the results.
Table = dict[str, list[Any]]

#: With these a spreadsheet's formula begins. page.js has them, too.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")


def rows(table: Table, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Returns a table row by row, with the labels of its configurations."""
    names = list(table)
    listed = [dict(zip(names, row, strict=True)) for row in zip(*table.values(), strict=True)]
    if "configuration" in table:
        return [row | {"configuration": labels[row["configuration"]]} for row in listed]
    return listed


def short(values: ArrayLike, digits: int = 5) -> list[Any]:
    """Returns numbers with a few digits, None where they are not finite."""
    flat = np.asarray(values, float).ravel().tolist()
    return [_integer(float(f"{x:.{digits}g}")) if math.isfinite(x) else None for x in flat]


def _integer(value: float) -> float | int:
    return int(value) if value.is_integer() else value


def stacked(parts: Iterable[Mapping[str, Any]]) -> Table:
    """Returns tables below each other; what is no list in one is the same in all of its rows."""
    table: Table = {}
    for part in parts:
        length = next(len(x) for x in part.values() if isinstance(x, list))
        for name, values in part.items():
            table.setdefault(name, []).extend(
                values if isinstance(values, list) else [values] * length
            )
    return table


def results_csv(findings: Findings) -> str:
    """Returns a row for each configuration and seed, as ``results.csv`` of a sweep."""
    names = swept(findings)
    header = ("configuration", *names, "seed", "final_return", "best_return")
    lines: list[Sequence[Any]] = [(*header, "env_steps_to_solve", "env_steps", "nonfinite")]
    for place, result in enumerate(findings.results):
        part, solving = result.configuration, result.solving
        settings = [say(part.settings.get(name)) for name in names]
        best = short(np.fmax.reduce(part.eval_return, axis=0), 7)
        final, end = short(result.final, 7), part.env_steps[-1].tolist()
        for s, seed in enumerate(part.seed.tolist()):
            solved = int(solving.steps[s]) if solving and solving.solved[s] else ""
            values = (seed, final[s], best[s], solved, end[s], int(part.nonfinite[s]))
            lines.append((place + 1, *settings, *values))
    return csv_text(map(_no_formulas, lines))


def table_csv(table: Table, labels: Sequence[str]) -> str:
    """Returns a table as a CSV file."""
    listed = rows(table, labels)
    return csv_text(map(_no_formulas, [table, *(row.values() for row in listed)]))


def _no_formulas(cells: Iterable[Any]) -> list[Any]:
    return [*map(_no_formula, cells)]


def _no_formula(cell: object) -> Any:
    """Returns a cell with an apostrophe before a name that a spreadsheet would compute.

    Run directories may be called "=HYPERLINK(1)". Numbers stay, also those that are texts.
    """
    if not isinstance(cell, str) or not cell.startswith(_FORMULA):
        return cell
    try:
        return cell if math.isfinite(float(cell)) else f"'{cell}"
    except ValueError:
        return f"'{cell}"
