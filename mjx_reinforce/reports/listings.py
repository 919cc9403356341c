"""The report's tables, as the page shows them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.reports import words
from mjx_reinforce.reports.findings import COMPARED, Findings, Result, by_speed, worst_seeds
from mjx_reinforce.reports.words import interval_in_words, number, percent, short_p, steps
from mjx_reinforce.statistics import Estimate

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
        cells = [(f"{seeds:,}", ""), _cell(each.mean), _cell(each.iqm), (number(each.tail), "")]
        if (solving := each.solving) is not None:
            share = f"{solving.at_end:,} of {seeds:,}"
            cells.append((share, interval_in_words(solving.rate, percent)))
            cells.append(_cell(solving.median, steps))
            cells.append((f"{int(solving.fell.sum()):,}", ""))
        cells.append((f"{int(np.sum(~np.isfinite(each.final))):,}", ""))
        rows.append(_row(each, cells))
    return {"header": [*header, "not finite"], "rows": rows}


def _speed_table(findings: Findings) -> Listing:
    """Returns the table of who learns faster: the fastest first, or who earned most on the way."""
    compared, header = findings.results[:COMPARED], ["", "configuration", "return while training"]
    order = np.argsort([-each.area.value for each in compared], kind="stable").tolist()
    if findings.speeds:
        header += ["mean steps to solve", "log-rank p, Holm"]
        order = by_speed(compared)
    rows = []
    for i in order:
        each, pair = compared[i], (min(i, order[0]), max(i, order[0]))
        cells = [_cell(each.area)]
        if findings.speeds and each.solving:
            p_value = short_p(findings.speeds[pair]) if i != order[0] else "fastest"
            cells += [_cell(each.solving.mean, steps), (p_value, "")]
        rows.append(_row(each, cells))
    return {"header": header, "rows": rows}


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
