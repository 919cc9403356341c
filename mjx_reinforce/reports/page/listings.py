"""The report's tables, as the page shows them."""

import math
from typing import Any

import numpy as np

from mjx_reinforce.reports.experiment import COMPARED, Result, counted
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.page import tables, words
from mjx_reinforce.reports.page.words import interval_in_words, number, percent, short_p, steps

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


def _worst(findings: Findings) -> Listing:
    """Returns the fates of the best configuration's worst seeds and of the others' worst one."""
    best, *others = findings.results
    rows = [_fate(findings, best, s) for s in tables.worst_seeds(best).tolist()]
    rows += [_fate(findings, each, tables.worst_seeds(each)[0]) for each in others[: COMPARED - 1]]
    return {"header": ["configuration", "seed", "return at the end", "what happened"], "rows": rows}


def key_figures(findings: Findings) -> list[tuple[str, str, str]]:
    """Returns the few numbers that stand out: name, value, what is below."""
    best = findings.results[0]
    seeds = sum(len(each.final) for each in findings.results)
    ends = max(int(each.configuration.env_steps[-1].max()) for each in findings.results)
    found = [
        ("seeds trained", f"{seeds:,}", counted(len(findings.results), "configuration")),
        (
            "return of the best" if findings.comparisons else "mean return",
            number(best.mean.value),
            interval_in_words(best.mean),
        ),
    ]
    if (solving := best.solving) is not None:
        said = f"of {len(best.final):,}; {interval_in_words(solving.rate, percent)}"
        found.append(("seeds that solve it", f"{solving.at_end:,}", said))
        until = steps(solving.median.value)
        found.append(("env steps until half", until, interval_in_words(solving.median, steps)))
    else:
        found.append(("worst tenth", number(best.tail.value), interval_in_words(best.tail)))
    found.append(("env steps a seed", f"{ends:,}", "at most"))
    return found


def _results_table(findings: Findings) -> dict[str, Any]:
    """Returns the table of all configurations."""
    header = ["", "configuration", "seeds", "mean", "interquartile mean", "worst tenth"]
    solving = findings.experiment.threshold is not None
    if solving:
        header += ["solved at the end", "steps until half solved", "fell back"]
    header += ["not finite"]
    listed = []
    for each in findings.results:
        cells = [(f"{len(each.final):,}", "")]
        for estimate in (each.mean, each.iqm, each.tail):
            cells.append((number(float(estimate.value)), interval_in_words(estimate)))
        if each.solving is not None:
            share = f"{each.solving.at_end:,} of {len(each.final):,}"
            median = each.solving.median
            cells.append((share, interval_in_words(each.solving.rate, percent)))
            cells.append((steps(median.value), interval_in_words(median, steps)))
            cells.append((f"{int(each.solving.fell.sum()):,}", ""))
        cells.append((f"{sum(not math.isfinite(x) for x in each.final):,}", ""))
        listed.append({"label": each.configuration.label, "cells": cells})
    return {"header": header, "rows": listed}


def _speed_table(findings: Findings) -> dict[str, Any]:
    """Returns the table of who learns faster: the fastest first."""
    compared = findings.results[:COMPARED]
    if len(compared) < 2:
        return {}
    solving = findings.experiment.threshold is not None
    header = ["", "configuration"]
    if solving:
        header += ["steps until half solved", "mean steps to solve", "log-rank p, Holm"]
    header += ["return while training", "p of it, Holm"]
    best_area = max(range(len(compared)), key=lambda i: float(compared[i].area.value))
    order = sorted(range(len(compared)), key=lambda i: _slowness(compared[i]))
    speeds = {frozenset((e.first, e.second)): e.adjusted for e in findings.learning.speeds}
    areas = {frozenset((e.first, e.second)): e.adjusted for e in findings.learning.areas}
    listed = []
    for i in order:
        each, cells = compared[i], []
        if each.solving is not None:
            median, mean = each.solving.median, each.solving.mean
            cells.append((steps(median.value), interval_in_words(median, steps)))
            cells.append((steps(float(mean.value)), interval_in_words(mean, steps)))
            cells.append((_p_against(speeds, i, order[0], "fastest"), ""))
        cells.append((number(float(each.area.value)), interval_in_words(each.area)))
        cells.append((_p_against(areas, i, best_area, "greatest"), ""))
        listed.append({"label": each.configuration.label, "cells": cells})
    return {"header": header, "rows": listed}


def _slowness(result: Result) -> float:
    """Returns what orders results, fastest first: steps to solve, or else the falling area."""
    return float(result.solving.mean.value if result.solving else -result.area.value)


def _p_against(adjusted: dict[frozenset[int], float], i: int, best: int, said: str) -> str:
    """Returns the p value of a result against the best, or what the best is."""
    if i == best:
        return said
    pair = frozenset((i, best))
    return short_p(adjusted[pair]) if pair in adjusted else "none"


def matrix(findings: Findings) -> list[dict[str, Any]]:
    """Returns who beats whom: a row and a cell for each configuration, None on the diagonal."""
    if not findings.comparisons:
        return []
    labels = findings.labels[:COMPARED]
    cells: list[list[Any]] = [[None] * len(labels) for _ in labels]
    for pair in findings.comparisons:
        sure = pair.adjusted < words.LEVEL
        for i, j, share in (
            (pair.first, pair.second, float(pair.improvement.value)),
            (pair.second, pair.first, 1 - float(pair.improvement.value)),
        ):
            cells[i][j] = {
                "text": f"{100 * share:.0f}",
                "sure": sure,
                "tint": 0 if share >= 0.5 else 1,
                "strength": f"{min(0.45, 0.9 * abs(share - 0.5)):.2f}",
                "title": f"{labels[i]} against {labels[j]}: {percent(share)}; "
                f"{words.p_value(pair.adjusted)}",
            }
    return [{"label": label, "cells": row} for label, row in zip(labels, cells, strict=True)]


def _against(findings: Findings) -> Listing:
    """Returns the comparisons of the best configuration with each other one."""
    if not findings.comparisons:
        return {}
    listed = [
        {
            "label": findings.results[pair.second].configuration.label,
            "cells": [
                (number(float(pair.difference.value)), interval_in_words(pair.difference)),
                (
                    percent(float(pair.improvement.value)),
                    interval_in_words(pair.improvement, percent),
                ),
                (short_p(pair.p_value), ""),
                (short_p(pair.adjusted), ""),
            ],
        }
        for pair in words.of_best(findings)
    ]
    header = ["against", "difference", "best is better", "p", "p, Holm"]
    return {"header": header, "rows": listed}


def _fate(findings: Findings, result: Result, s: int) -> dict[str, Any]:
    final = float(result.final[s])
    cells = [
        (str(int(result.configuration.seed[s])), ""),
        (number(final) if math.isfinite(final) else "not finite", ""),
        (_how_it_ended(findings, result, s), ""),
    ]
    return {"label": result.configuration.label, "cells": cells}


def _how_it_ended(findings: Findings, result: Result, s: int) -> str:
    """Returns how a seed ended, and how it came to that."""
    part, threshold = result.configuration, findings.experiment.threshold
    returns, at = part.eval_return[:, s], part.env_steps[:, s]
    if not np.isfinite(returns[-1]):
        first = len(returns) - int(np.argmax(np.isfinite(returns[::-1])))
        since = at[first % len(returns)] if np.isfinite(returns).any() else 0
        return f"not finite since {steps(float(since))} env steps"
    top = int(np.nanargmax(returns))
    best = f"its best, {number(returns[top])}, was at {steps(float(at[top]))} env steps"
    if threshold is None:
        return "at its best at the end" if returns[-1] == returns[top] else best
    if returns[-1] >= threshold:
        return f"solved, first at {steps(float(result.solving.steps[s]))}" if result.solving else ""
    if returns[top] < threshold:
        return f"never solved; {best}"
    lost = int(np.flatnonzero(returns >= threshold)[-1]) + 1
    first_time = steps(float(at[np.argmax(returns >= threshold)]))
    return f"solved at {first_time}, lost it at {steps(float(at[lost]))} env steps"
