"""The share of seeds that have solved the task, over the env steps."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import Table, short, stacked
from mjx_reinforce.reports.findings import Findings, Result
from mjx_reinforce.reports.words import number
from mjx_reinforce.statistics.survival import kaplan_meier


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart; none where no seed solved the task."""
    if not any(result.solving and result.solving.ever for result in findings.results):
        return
    shares = _shares(findings)
    interval = ", with its pointwise 95% interval" if charts.has_width(shares) else ""
    yield charts.make_chart(
        findings,
        [_bands_and_lines(findings), charts.moment_line(findings)],
        320,
        name="solved",
        title="How many have solved it",
        caption=(
            f"The share of seeds that have reached {number(findings.experiment.threshold or 0.0)} "
            f"at least once, after Kaplan and Meier{interval}. A seed that fell back later still "
            "counts here; table 1 says how many did. The curve's last point is the end of each "
            "seed's training."
        ),
        alt="Share of seeds over env steps, a rising line for each configuration shown.",
        data={"solved": shares},
        listed="solved",
    )


def _bands_and_lines(findings: Findings) -> charts.Spec:
    """Returns the shares as stairs: they rise where a seed solves the task, not between."""
    title = "seeds that have solved the task"
    tips = charts.tooltip(
        env_steps=("env steps", ",.0f"),
        share=("have solved", ".1%"),
        low=("95% from", ".1%"),
        high=("to", ".1%"),
    )
    band = {"y": charts.quantity("low", title=title), "y2": {"field": "high"}}
    share = charts.quantity("share", title=title, scale={"domain": [0, 1]}, axis={"format": ".0%"})
    line = {"y": share, "strokeDash": charts.dashes(findings.labels), "tooltip": tips}
    return charts.shown_rows("solved") | {
        "encoding": {"x": charts.STEPS, "color": charts.series(findings.labels)},
        "layer": [
            charts.layer("area", band, opacity=0.18, interpolate="step-after"),
            charts.layer("line", line, strokeWidth=2.2, interpolate="step-after"),
        ],
    }


def _shares(findings: Findings) -> Table:
    """Returns the share of seeds that have solved the task, until the first seed's end.

    There all that came until a seed's own end counts, so that the last share is that of the seeds
    who ever did.
    """

    def share_rows(place: int, result: Result) -> dict[str, Any]:
        """Returns the share of one configuration and its interval, on the grid up to its end."""
        steps = findings.grid[findings.grid <= result.configuration.env_steps[-1].min()]
        assert result.solving is not None
        curve = kaplan_meier(np.minimum(result.solving.steps, steps[-1]), result.solving.solved)
        # How many of the curve's steps lie at or before each point of the grid: 0 is its start.
        index = np.searchsorted(curve.steps, steps, side="right")
        # Kaplan and Meier's is the share that has not, so that the ends change places.
        unsolved_shares = {"share": curve.probability, "low": curve.high, "high": curve.low}
        shares = {
            name: short(1 - np.concatenate([[1.0], share])[index], 4)
            for name, share in unsolved_shares.items()
        }
        return {"configuration": place, "env_steps": short(steps, 7), **shares}

    return stacked(share_rows(place, result) for place, result in enumerate(findings.results))
