"""The report's tables, as the page shows them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.reports import words
from mjx_reinforce.reports.findings import COMPARED, Findings, Result, by_speed, worst_seeds
from mjx_reinforce.reports.words import interval_in_words, number, percent, short_p, steps
from mjx_reinforce.statistics import Estimate, estimate_mean
from mjx_reinforce.statistics.tolerance import tolerance_seeds

#: A table: its ``header``, and ``rows`` of a ``label`` and ``cells``, pairs of a value and what
#: stands below it. Where the header has a column more, the first is the rank of the row.
Listing = dict[str, Any]


def listings(findings: Findings) -> dict[str, Listing]:
    """Returns the tables of a report by name, in the order of the page."""
    tables = {
        "results": _results_table(findings),
        "reliability": _reliability_table(findings),
        "speed": _speed_table(findings),
        "against": _against(findings),
        "worst": _worst(findings),
    }
    # The page numbers those that are there.
    return {name: listing for name, listing in tables.items() if listing}


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
    for result in findings.results:
        num_seeds = len(result.final)
        cells = [(f"{num_seeds:,}", ""), _cell(result.mean), _cell(result.iqm)]
        cells.append((number(result.tail), ""))
        solving = result.solving
        if solving is not None:
            # In counts: a reader asks of how many seeds a share is.
            share = f"{solving.at_end:,} of {num_seeds:,}"
            cells.append((share, interval_in_words(solving.rate, percent)))
            cells.append(_cell(solving.median, steps))
            cells.append((f"{int(solving.fell.sum()):,}", ""))
        cells.append((f"{int(np.sum(~np.isfinite(result.final))):,}", ""))
        rows.append(_row(result, cells))
    return {"header": [*header, "not finite"], "rows": rows}


def _reliability_table(findings: Findings) -> Listing:
    """Returns the table of what nearly all runs return, and of drops after the peak."""
    header = ["", "configuration", "90% of runs return at least", "drop after the peak"]
    rows = []
    for result in findings.results:
        floor = number(result.floor)
        if len(result.final) < tolerance_seeds():
            floor = f"needs {tolerance_seeds()} seeds"
        largest = number(float(result.drops.max()))
        rows.append(_row(result, [(floor, ""), _cell(estimate_mean(result.drops)), (largest, "")]))
    return {"header": [*header, "largest drop"], "rows": rows}


def _speed_table(findings: Findings) -> Listing:
    """Returns the table of who learns faster: the fastest first, or who earned most on the way."""
    results = findings.results[:COMPARED]
    header = ["", "configuration", "return while training"]
    order = np.argsort([-result.area.value for result in results], kind="stable").tolist()
    if findings.speeds:
        header += ["mean steps to solve", "log-rank p, Holm"]
        order = by_speed(results)
    fastest_index = order[0]
    rows = []
    for i in order:
        result = results[i]
        cells = [_cell(result.area)]
        if findings.speeds and result.solving:
            # Tests are kept once a pair, the lower place first.
            p_value = "fastest"
            if i != fastest_index:
                p_value = short_p(findings.speeds[min(i, fastest_index), max(i, fastest_index)])
            cells += [_cell(result.solving.mean, steps), (p_value, "")]
        rows.append(_row(result, cells))
    return {"header": header, "rows": rows}


def _against(findings: Findings) -> Listing:
    """Returns the comparisons of the best configuration with each other one."""
    rows = []
    for pair in words.of_best(findings):
        cells = [_cell(pair.difference), _cell(pair.improvement, percent)]
        cells += [(short_p(pair.p_value), ""), (short_p(pair.adjusted), "")]
        rows.append(_row(findings.results[pair.second], cells))
    if not rows:
        return {}
    header = ["against", "difference", "best is better", "p", "p, Holm"]
    return {"header": header, "rows": rows}


def _worst(findings: Findings) -> Listing:
    """Returns the best configuration's worst seeds and the others' worst one."""
    best, *challengers = findings.results
    seeds = [(best, s) for s in worst_seeds(best)]
    seeds += [(result, worst_seeds(result)[0]) for result in challengers[: COMPARED - 1]]
    header = ["configuration", "seed", "final return", "best return"]
    if findings.experiment.threshold is not None:
        header.append("first solved at")
    rows = []
    for result, s in seeds:
        part = result.configuration
        # fmax leaves NaN out: a seed that broke may have been good before.
        best_return = float(np.fmax.reduce(part.eval_return[:, s]))
        cells = [str(int(part.seed[s])), number(float(result.final[s])), number(best_return)]
        if result.solving:
            solving_steps = "never"
            if result.solving.solved[s]:
                solving_steps = steps(float(result.solving.steps[s]))
            cells.append(solving_steps)
        rows.append(_row(result, [(cell, "") for cell in cells]))
    return {"header": header, "rows": rows}
