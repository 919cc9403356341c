"""What a report says of how fast configurations learn."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from mjx_reinforce.reports.experiment import COMPARED, Result, counted
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.learning import fastest
from mjx_reinforce.reports.page import words
from mjx_reinforce.reports.page.words import LEVEL, interval_in_words, number, p_value, steps


def learning_answer(findings: Findings) -> list[str]:
    """Returns the page's answer: what was reached, and who got there faster.

    Where the returns at the end cannot be told apart, and one configuration is surely faster than
    others, that comes first.
    """
    return [*headline(findings), *sentences(findings)]


def headline(findings: Findings) -> list[str]:
    """Returns the answer without what follows of the speed."""
    said, (first, slower) = words.answer(findings), pace(findings)
    others = len(findings.results[:COMPARED]) - 1
    if not slower or len(words.unsure(findings)) < others:
        return said
    who = f"Fastest is {first}" if len(slower) == others else f"{first} is surely {faster(slower)}"
    return [f"{who}; the returns at the end are a tie.", *said]


def sentences(findings: Findings) -> list[str]:
    """Returns who learns faster and how sure that is; nothing of one configuration."""
    if not findings.comparisons:
        return []
    return [*_of_speed(findings), *_of_area(findings)]


def pace(findings: Findings) -> tuple[str, list[str]]:
    """Returns what solves the task soonest, and what is surely slower: names of configurations."""
    names = findings.labels[:COMPARED]
    first = fastest(findings.results[:COMPARED])
    tests = [each for each in findings.learning.speeds if first in (each.first, each.second)]
    slower = [each for each in tests if each.adjusted < LEVEL]
    return names[first], [names[each.first + each.second - first] for each in slower]


def faster(slower: Sequence[str]) -> str:
    """Returns "faster than" and names, the first three of many."""
    more = f" and {len(slower) - 3} more" if len(slower) > 3 else ""
    return f"faster than {', '.join(slower[:3])}{more}"


def _of_speed(findings: Findings) -> Iterator[str]:
    compared, speeds = findings.results[:COMPARED], findings.learning.speeds
    if not speeds or not any(each.solving.solved.any() for each in compared if each.solving):
        return
    first = fastest(compared)
    tests = [each for each in speeds if first in (each.first, each.second)]
    slower = [each for each in tests if each.adjusted < LEVEL]
    pairs = counted(len(speeds), "pair")
    half = f": {_half_solved(compared[first])}" if first else ""  # the best's is said already
    yield f"The task is solved soonest by {compared[first].configuration.label}{half}."
    if slower:
        worst = p_value(max(each.adjusted for each in slower))
        which = (
            "each of the others" if len(slower) == len(tests) else f"{len(slower)} of the others"
        )
        which = f"the other, {_other(findings, first)}" if len(tests) == 1 else which
        yield (
            f"It is faster than {which} by the log-rank test ({worst}{_at_most(slower, worst)} "
            f"after Holm's correction for {pairs})."
        )
    if len(slower) < len(tests):
        unsure = [each for each in tests if each.adjusted >= LEVEL]
        least = p_value(min(each.adjusted for each in unsure))
        places = [each.second if each.first == first else each.first for each in unsure]
        names = [f"“{compared[i].configuration.label}”" for i in places[:3]]
        more = f" and {len(places) - 3} more" if len(places) > 3 else ""
        yield (
            f"The log-rank test does not tell its speed from that of {', '.join(names)}{more} "
            f"({least}{'' if len(unsure) == 1 or least == 'p = 1' else ' or more'})."
        )


def _at_most(slower: Sequence[Any], worst: str) -> str:
    return " or less" if len(slower) > 1 and not worst.startswith("p <") else ""


def _other(findings: Findings, first: int) -> str:
    (other,) = [each for i, each in enumerate(findings.results[:COMPARED]) if i != first]
    return other.configuration.label


def _half_solved(result: Result) -> str:
    solving = result.solving
    if solving is None or math.isnan(solving.median.value):
        return "fewer than half of its seeds solve it"
    bounds = words.within(solving.median, steps)
    return f"half of its seeds have after {steps(solving.median.value)} env steps ({bounds})"


def _of_area(findings: Findings) -> Iterator[str]:
    compared, pairs = findings.results[:COMPARED], findings.learning.areas
    if not pairs:
        return
    order = sorted(range(len(compared)), key=lambda i: -float(compared[i].area.value))
    first, second = order[:2]
    pair = next(each for each in pairs if {each.first, each.second} == {first, second})
    difference = pair.difference
    low, high = float(difference.low), float(difference.high)
    value = float(difference.value)
    if pair.first == second:
        value, low, high = -value, -high, -low
    bounds = "" if math.isnan(low) else f"95 % interval {number(low)} to {number(high)}; "
    yield (
        f"Over the first {steps(findings.learning.until)} env steps of its training, "
        f"{compared[first].configuration.label} has the greatest mean return, "
        f"{number(float(compared[first].area.value))}: {number(value)} above the next, "
        f"{compared[second].configuration.label} ({bounds}{p_value(pair.adjusted)} after Holm's "
        "correction)."
    )


def speed_table(findings: Findings) -> dict[str, Any]:
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


def short_p(value: float) -> str:
    """Returns a p value without its name: "0.012", "< 0.001", "1"."""
    return p_value(value).removeprefix("p = ").removeprefix("p ")
