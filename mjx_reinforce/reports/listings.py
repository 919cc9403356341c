"""The report's tables, as the page shows them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.reports import words
from mjx_reinforce.reports.findings import COMPARED, Findings, Result, SpeedTest, worst_seeds
from mjx_reinforce.reports.words import interval_in_words, number, percent, short_p, steps
from mjx_reinforce.statistics import Estimate
from mjx_reinforce.statistics.comparisons import Comparison

#: A table: its ``header``, and ``rows`` of a ``label`` and ``cells``, pairs of a value and what
#: stands below it. Where the header has a column more, the first is the rank of the row.
Listing = dict[str, Any]


def listings(findings: Findings) -> dict[str, Listing]:
    """Returns the tables of a report by name, in the order of the page."""
    found = {
        "results": _results_table(findings),
        "speed": _speed_table(findings),
        "against": _against(findings),
        "worst": _worst(findings),
    }
    return {name: listing for name, listing in found.items() if listing}


def _row(result: Result, cells: Sequence[tuple[str, str]]) -> dict[str, Any]:
    return {"label": result.configuration.label, "cells": cells}


def _cell(estimate: Estimate, form: Callable[[float], str] = number) -> tuple[str, str]:
    """Returns an estimate in words, and its interval below it."""
    return form(float(estimate.value)), interval_in_words(estimate, form)


def _results_table(findings: Findings) -> Listing:
    """Returns the table of all configurations."""
    header = ["", "configuration", "seeds", "mean", "interquartile mean", "worst tenth"]
    if findings.experiment.threshold is not None:
        header += ["solved at the end", "steps until half solved", "fell back"]
    rows = []
    for each in findings.results:
        seeds = len(each.final)
        cells = [(f"{seeds:,}", ""), *map(_cell, (each.mean, each.iqm, each.tail))]
        if (solving := each.solving) is not None:
            share = f"{solving.at_end:,} of {seeds:,}"
            cells.append((share, interval_in_words(solving.rate, percent)))
            cells.append(_cell(solving.median, steps))
            cells.append((f"{int(solving.fell.sum()):,}", ""))
        cells.append((f"{int(np.sum(~np.isfinite(each.final))):,}", ""))
        rows.append(_row(each, cells))
    return {"header": [*header, "not finite"], "rows": rows}


def _speed_table(findings: Findings) -> Listing:
    """Returns the table of who learns faster: the fastest first."""
    compared = findings.results[:COMPARED]
    if len(compared) < 2:
        return {}
    header = ["", "configuration"]
    if findings.experiment.threshold is not None:
        header += ["steps until half solved", "mean steps to solve", "log-rank p, Holm"]
    best_area = max(range(len(compared)), key=lambda i: float(compared[i].area.value))
    order = sorted(range(len(compared)), key=lambda i: _slowness(compared[i]))
    rows = []
    for i in order:
        each, cells = compared[i], []
        if (solving := each.solving) is not None:
            cells += [_cell(solving.median, steps), _cell(solving.mean, steps)]
            cells.append((_p_against(findings.learning.speeds, i, order[0], "fastest"), ""))
        cells.append(_cell(each.area))
        cells.append((_p_against(findings.learning.areas, i, best_area, "greatest"), ""))
        rows.append(_row(each, cells))
    return {"header": [*header, "return while training", "p of it, Holm"], "rows": rows}


def _slowness(result: Result) -> float:
    """Returns what orders results, fastest first: steps to solve, or else the falling area."""
    return float(result.solving.mean.value if result.solving else -result.area.value)


def _p_against(tests: Sequence[SpeedTest | Comparison], i: int, best: int, said: str) -> str:
    """Returns the p value of a result against the best, or what the best is."""
    found = [each.adjusted for each in tests if {each.first, each.second} == {i, best}]
    return said if i == best else short_p(found[0]) if found else "none"


def _against(findings: Findings) -> Listing:
    """Returns the comparisons of the best configuration with each other one."""
    rows = []
    for pair in words.of_best(findings):
        cells = [_cell(pair.difference), _cell(pair.improvement, percent)]
        cells += [(short_p(pair.p_value), ""), (short_p(pair.adjusted), "")]
        rows.append(_row(findings.results[pair.second], cells))
    header = ["against", "difference", "best is better", "p", "p, Holm"]
    return {"header": header, "rows": rows} if rows else {}


def _worst(findings: Findings) -> Listing:
    """Returns the best configuration's worst seeds and the others' worst one."""
    best, *others = findings.results
    seeds = [(best, s) for s in worst_seeds(best)]
    seeds += [(each, worst_seeds(each)[0]) for each in others[: COMPARED - 1]]
    header = ["configuration", "seed", "final return", "best return"]
    if findings.experiment.threshold is not None:
        header.append("first solved at")
    rows = []
    for each, s in seeds:
        part, solving = each.configuration, each.solving
        best_return = float(np.fmax.reduce(part.eval_return[:, s]))
        cells = [str(int(part.seed[s])), number(float(each.final[s])), number(best_return)]
        if solving:
            cells.append(steps(float(solving.steps[s])) if solving.solved[s] else "never")
        rows.append(_row(each, [(cell, "") for cell in cells]))
    return {"header": header, "rows": rows}
