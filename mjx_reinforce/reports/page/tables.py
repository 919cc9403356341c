"""The report's figures as tables, from which its charts are drawn."""

import math
from typing import Literal

import numpy as np

from mjx_reinforce.reports.experiment import Result, ordered, say
from mjx_reinforce.reports.findings import Findings, swept, values_of
from mjx_reinforce.reports.page.columns import Table, join_tables, short
from mjx_reinforce.reports.page.distributions import distributions
from mjx_reinforce.reports.statistics.profiles import performance_profile
from mjx_reinforce.reports.statistics.survival import kaplan_meier

#: Points of a curve, at most.
_MOST_POINTS = 80
#: Seeds that are drawn one by one: of one configuration, and of all together.
_DRAWN_OF_ONE = 40
_DRAWN_OF_ALL = 480
#: How many of the worst seeds are named, and what share of all, at most.
_WORST, _WORST_SHARE = 10, 0.25


def chart_tables(findings: Findings) -> dict[str, Table]:
    """Returns the data of all charts by name, see ``charts``; no more for a thousand seeds."""
    return {
        "curves": _curves(findings),
        "seeds": _seeds(findings),
        "final": _final(findings),
        **distributions(findings),
        "solved": _solved(findings),
        "profile": _profile(findings),
        **worst_curves(findings),
        **{
            f"sensitivity-{n}": sensitivity_table(findings, s)
            for n, s in enumerate(swept(findings))
        },
    }


def _curves(findings: Findings) -> Table:
    parts = []
    for place, result in enumerate(findings.results):
        known = np.isfinite(result.band.value)
        parts.append(
            {
                "configuration": [place] * int(known.sum()),
                "env_steps": short(findings.grid[known], 7),
                "value": short(result.band.value[known]),
                "low": short(result.band.low[known]),
                "high": short(result.band.high[known]),
            }
        )
    return join_tables(parts)


def _seeds(findings: Findings) -> Table:
    """Returns some curves of each configuration: from the worst seed to the best, evenly."""
    number = max(5, min(_DRAWN_OF_ONE, _DRAWN_OF_ALL // len(findings.results)))
    grid = findings.grid
    parts = []
    for place, result in enumerate(findings.results):
        ranked = np.argsort(np.nan_to_num(result.final, nan=-np.inf), kind="stable")
        chosen = np.unique(np.linspace(0, len(ranked) - 1, min(number, len(ranked))).round())
        for s in ranked[chosen.astype(int)]:
            known = np.isfinite(result.seeds[:, s])
            length = int(known.sum())
            parts.append(
                {
                    "configuration": [place] * length,
                    "seed": [int(result.configuration.seed[s])] * length,
                    "env_steps": short(grid[known], 7),
                    "value": short(result.seeds[known, s], 4),
                }
            )
    return join_tables(parts)


def _final(findings: Findings) -> Table:
    results = findings.results
    spread = [np.quantile(each.scores, [0.1, 0.9]) for each in results]
    return {
        "configuration": list(range(len(results))),
        "place": list(range(len(results))),
        "value": short([each.mean.value for each in results]),
        "low": short([each.mean.low for each in results]),
        "high": short([each.mean.high for each in results]),
        "tenth": short([low for low, _ in spread]),
        "ninetieth": short([high for _, high in spread]),
    }


def _solved(findings: Findings) -> Table:
    """Returns the share of seeds that have solved the task, until the first seed's end.

    There all that came until a seed's own end counts, so that the last share is that of the seeds
    who ever did.
    """
    table: Table = {n: [] for n in ("configuration", "env_steps", "share", "low", "high")}
    for place, result in enumerate(findings.results):
        if result.solving is None:
            continue
        steps = findings.grid[findings.grid <= result.configuration.env_steps[-1].min()]
        solving = result.solving
        curve = kaplan_meier(np.minimum(solving.steps, steps[-1]), solving.solved)
        at = np.searchsorted(curve.steps, steps, side="right")
        table["configuration"] += [place] * len(steps)
        table["env_steps"] += short(steps, 7)
        # Kaplan and Meier's is the share that has not.
        for name, values in (
            ("share", curve.probability),
            ("low", curve.high),
            ("high", curve.low),
        ):
            table[name] += short(1 - np.concatenate([[1.0], values])[at], 4)
    return table


def _profile(findings: Findings) -> Table:
    finals = np.concatenate([each.final for each in findings.results])
    finals = finals[np.isfinite(finals)]
    thresholds = (
        np.linspace(finals.min(), finals.max(), _MOST_POINTS) if finals.size else np.zeros(1)
    )
    parts = []
    for place, result in enumerate(findings.results):
        share = performance_profile(result.final, thresholds)
        parts.append(
            {
                "configuration": [place] * len(thresholds),
                "threshold": short(thresholds),
                "share": short(share.value, 4),
                "low": short(share.low, 4),
                "high": short(share.high, 4),
            }
        )
    return join_tables(parts)


def worst_seeds(result: Result) -> np.ndarray:
    """Returns the places of the worst seeds of a configuration, the worst first: at least one."""
    number = min(_WORST, math.ceil(_WORST_SHARE * len(result.final)))
    return np.argsort(np.nan_to_num(result.final, nan=-np.inf), kind="stable")[:number]


def worst_curves(findings: Findings) -> dict[str, Table]:
    """Returns the worst seeds of the best configuration, as they were evaluated, and its band."""
    result = findings.results[0]
    part = result.configuration
    parts = []
    for s in worst_seeds(result):
        returns = part.eval_return[:, s]
        keep = np.unique(np.linspace(0, len(returns) - 1, min(len(returns), _MOST_POINTS)).round())
        at = keep.astype(int)[np.isfinite(returns[keep.astype(int)])]
        parts.append(
            {
                "configuration": [0] * len(at),
                "seed": [int(part.seed[s])] * len(at),
                "env_steps": short(part.env_steps[at, s], 7),
                "value": short(returns[at], 4),
            }
        )
    known = np.isfinite(result.band.value)
    band = {
        "configuration": [0] * int(known.sum()),
        "env_steps": short(findings.grid[known], 7),
        "value": short(result.band.value[known]),
    }
    return {"worst": join_tables(parts), "band": band}


def axis_of(findings: Findings, name: str) -> Literal["log", "linear", "ordinal"]:
    """Returns the axis for a setting: "log", "linear" or "ordinal"."""
    values = values_of(findings, name)
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        return "ordinal"
    low, high = min(values), max(values)
    return "log" if low > 0 and high / low >= 8 else "linear"


def sensitivity_table(findings: Findings, name: str) -> Table:
    """Returns the final return over the values of a setting, in their order."""
    places = {repr(x): n for n, x in enumerate(ordered(values_of(findings, name)))}
    order = sorted(
        range(len(findings.results)),
        key=lambda i: places[repr(values_of(findings, name)[i])],
    )
    results = [findings.results[i] for i in order]
    others = [
        tuple((k, repr(v)) for k, v in each.configuration.settings.items() if k != name)
        for each in results
    ]
    best = next(other for other, i in zip(others, order, strict=True) if i == 0)
    numbers = {other: n for n, other in enumerate(dict.fromkeys(others))}
    ordinal = axis_of(findings, name) == "ordinal"
    values = [each.configuration.settings.get(name) for each in results]
    return {
        "configuration": order,
        "setting": [say(x) for x in values] if ordinal else values,
        "value": short([each.mean.value for each in results]),
        "low": short([each.mean.low for each in results]),
        "high": short([each.mean.high for each in results]),
        "others": [numbers[other] for other in others],
        "best": [other == best for other in others],
    }
