"""The report's charts over env steps: learning curves, and who has solved the task."""

import math
from collections.abc import Iterator
from typing import Any

import altair as alt
import numpy as np

from mjx_reinforce.reports.experiment import Result
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.page import vega
from mjx_reinforce.reports.page.columns import Table, short, stacked
from mjx_reinforce.reports.page.words import number
from mjx_reinforce.statistics.survival import kaplan_meier

_HEIGHT = 320
#: Seeds that are drawn one by one: of one configuration, and of all together.
_DRAWN_OF_ONE = 40
_DRAWN_OF_ALL = 480
#: How many of the worst seeds are named, and what share of all, at most.
_WORST, _WORST_SHARE = 10, 0.25


def _return_axis(field: str = "value:Q") -> alt.Y:
    return alt.Y(field, title="return of the deterministic policy", scale=alt.Scale(zero=False))


def curves(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the interquartile mean and its band; of one configuration, its seeds too."""
    labels, threshold = findings.labels, findings.experiment.threshold
    colours, y, shown = vega.series(labels), _return_axis(), vega.shown_rows("curves")
    low = alt.Y("low:Q", title=y["title"])
    near = alt.selection_point(
        name="near", on="pointerover", fields=["env_steps"], nearest=True, empty=False
    )
    seen = alt.condition(near, alt.value(1), alt.value(0))
    seeds = vega.shown_rows("seeds").transform_filter("length(shown) == 1")
    # Vega-Lite leaves words out of a nearest point's tooltip, unless all data are in it.
    points = shown.mark_point(size=70, filled=True, tooltip=alt.TooltipContent("data"))
    layers = [
        seeds.mark_line(strokeWidth=0.8, opacity=0.35, clip=True).encode(
            x=vega.STEPS, y=y, detail="seed:N", color=colours
        ),
        shown.mark_area(opacity=0.18, clip=True).encode(
            x=vega.STEPS, y=low, y2="high:Q", color=colours
        ),
        shown.mark_line(strokeWidth=2.2, clip=True).encode(
            x=vega.STEPS, y=y, color=colours, strokeDash=vega.dashes(labels)
        ),
        vega.moment_line(findings),
        points.encode(x=vega.STEPS, y=y, color=colours, opacity=seen).add_params(near),
        *vega.threshold_line(findings, "y"),
    ]
    beyond = ""
    if threshold is not None and vega.drawn_threshold(findings) is None:
        beyond = f" The return that counts as solved, {number(threshold)}, lies above the figure."
    yield vega.make_chart(
        findings,
        layers,
        _HEIGHT,
        name="curves",
        title="Learning curves",
        caption=(
            "The interquartile mean over seeds of the return without exploration, and its 95 % "
            "bootstrap interval; with one configuration shown, thin lines are single seeds, from "
            "worst to best. The dotted line is the slider's time below. Point at a curve to read "
            f"it.{beyond}"
        ),
        alt="Return over env steps, a line and a band for each configuration that is shown.",
        data={"curves": _bands(findings), "seeds": _seeds(findings)},
        listed="curves",
    )


def _bands(findings: Findings) -> Table:
    def part(place: int, result: Result) -> dict[str, Any]:
        known = np.isfinite(result.band.value)
        return {
            "configuration": place,
            "env_steps": short(findings.grid[known], 7),
            **{name: short(getattr(result.band, name)[known]) for name in result.band._fields},
        }

    return stacked(part(place, result) for place, result in enumerate(findings.results))


def _seeds(findings: Findings) -> Table:
    """Returns some curves of each configuration: from the worst seed to the best, evenly."""
    most = max(5, min(_DRAWN_OF_ONE, _DRAWN_OF_ALL // len(findings.results)))

    def parts() -> Iterator[dict[str, Any]]:
        for place, result in enumerate(findings.results):
            ranked = _from_the_worst(result)
            chosen = np.unique(np.linspace(0, len(ranked) - 1, min(most, len(ranked))).round())
            for s in ranked[chosen.astype(int)]:
                known = np.isfinite(result.seeds[:, s])
                yield {
                    "configuration": place,
                    "seed": int(result.configuration.seed[s]),
                    "env_steps": short(findings.grid[known], 7),
                    "value": short(result.seeds[known, s], 4),
                }

    return stacked(parts())


def solved(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the share of seeds that have solved the task, if any did."""
    if not any(each.solving and each.solving.ever for each in findings.results):
        return
    tips = vega.tooltips(env_steps=("env steps", ",.0f"), share=("have solved", ".1%"))
    title = "seeds that have solved the task"
    layers = vega.share_layers(
        findings, "solved", vega.STEPS, title=title, tips=tips, interpolate="step-after"
    )
    yield vega.make_chart(
        findings,
        [*layers, vega.moment_line(findings)],
        _HEIGHT,
        name="solved",
        title="How many have solved it",
        caption=(
            f"The share of seeds that have reached {number(findings.experiment.threshold or 0.0)} "
            "at least once, after Kaplan and Meier, with its pointwise 95 % interval. A seed that "
            "fell back later still counts here; table 1 says how many did. The curve's last "
            "point is the end of each seed's training."
        ),
        alt="Share of seeds over env steps, a rising line for each configuration shown.",
        data={"solved": _solved_shares(findings)},
        listed="solved",
    )


def _solved_shares(findings: Findings) -> Table:
    """Returns the share of seeds that have solved the task, until the first seed's end.

    There all that came until a seed's own end counts, so that the last share is that of the seeds
    who ever did.
    """

    def part(place: int, result: Result) -> dict[str, Any]:
        steps = findings.grid[findings.grid <= result.configuration.env_steps[-1].min()]
        assert result.solving is not None
        curve = kaplan_meier(np.minimum(result.solving.steps, steps[-1]), result.solving.solved)
        at = np.searchsorted(curve.steps, steps, side="right")
        # Kaplan and Meier's is the share that has not.
        left = {"share": curve.probability, "low": curve.high, "high": curve.low}
        shares = {n: short(1 - np.concatenate([[1.0], x])[at], 4) for n, x in left.items()}
        return {"configuration": place, "env_steps": short(steps, 7), **shares}

    return stacked(part(place, result) for place, result in enumerate(findings.results))


def worst_seeds(result: Result) -> np.ndarray:
    """Returns the places of the worst seeds of a configuration, the worst first: at least one."""
    return _from_the_worst(result)[: min(_WORST, math.ceil(_WORST_SHARE * len(result.final)))]


def _from_the_worst(result: Result) -> np.ndarray:
    """Returns the places of all seeds, ordered by the return at the end; not finite is worst."""
    return np.argsort(np.nan_to_num(result.final, nan=-np.inf), kind="stable")
