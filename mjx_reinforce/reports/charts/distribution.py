"""The returns of all seeds at the slider's moment: a histogram for each configuration."""

from collections.abc import Iterator

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import Table, short, stacked
from mjx_reinforce.reports.findings import Findings, Result

#: Height of a configuration's row, in pixels.
ROW = 66
#: Bars of a histogram, at most.
_BARS = 36


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart."""
    borders, several = _borders(findings), len(findings.results) > 1
    slider = len(charts.slider_stops(findings)) > 1
    earlier = ", and where a configuration ended earlier," * several
    when = (
        " at the slider's time. Before its end, a dotted line marks that time in the curves. "
        f"At its end{earlier} they show"
    )
    rows = " The tallest bar of each row has the same height." * several
    yield charts.make_chart(
        findings,
        [_labels(), _bars(findings, borders)],
        ROW * len(findings.labels[: charts.SHOWN]),
        name="distribution",
        title="Where the seeds are",
        caption=(
            f"Histograms of all seeds' returns{when if slider else ':'} each seed's last "
            f"evaluation, as in table 1.{rows} The outermost bars include what lies beyond them."
        ),
        alt="A histogram of returns for each configuration shown, with its median and worst.",
        data=_histograms(findings, borders),
    )


#: Rows lie on one another, the best on top.
_Y = {"axis": None, "scale": {"domain": [0, {"expr": "length(shown)"}], "nice": False}}


def _at_the_moment(data: str, top: str) -> charts.Spec:
    """Returns the rows of a moment, with the ground of each one's row and how high it reaches."""
    base = "length(shown) - 1 - indexof(shown, datum.configuration)"
    return charts.shown_rows(
        data,
        {"filter": "datum.moment == moment"},
        {"calculate": base, "as": "base"},
        {"calculate": f"datum.base + {top}", "as": "top"},
    )


def _labels() -> charts.Spec:
    """Returns the ground of each row and, at its top, what is said of it."""
    ground = {"x": {"value": 0}, "x2": {"value": "width"}, "y": charts.quantity("base", **_Y)}
    said = {"x": {"value": 2}, "y": charts.quantity("top", **_Y), "text": {"field": "said"}}
    look = {"align": "left", "baseline": "top", "lineBreak": "\n", "lineHeight": 15}
    return _at_the_moment("moments", "0.92") | {
        "layer": [
            charts.layer("rule", ground, opacity=0.6),
            charts.layer("text", said, limit={"expr": "width"}, **look),
        ]
    }


def _bars(findings: Findings, borders: np.ndarray) -> charts.Spec:
    ends = {"domain": [float(borders[0]), float(borders[-1])], "nice": False}
    said = {"low": ("return from", ",.0f"), "high": ("to", ",.0f")}
    encoding = {
        "x": charts.quantity("low", title="return", scale=ends),
        "x2": {"field": "high"},
        "y": charts.quantity("base", **_Y),
        "y2": {"field": "top"},
        "color": charts.series(findings.labels, legend=False),
        "tooltip": charts.tooltip(**said, share=("share of seeds", ".1%")),
    }
    return {
        **_at_the_moment("histogram", "0.5 * datum.height"),
        **charts.layer("bar", encoding, opacity=0.85, binSpacing=0),
    }


def _borders(findings: Findings) -> np.ndarray:
    """Returns the edges of the histograms' bars; what is beyond counts in the outer ones."""
    values = np.concatenate([each.seeds.ravel() for each in findings.results])
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.001, 0.999]) if values.size else (0.0, 1.0)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, _BARS + 1)


def _histograms(findings: Findings, borders: np.ndarray) -> dict[str, Table]:
    """Returns the histograms of all configurations at all moments, and what is said of each.

    The last moment is the end: each seed's last evaluation, which tables are of. The grid ends
    where the first seed did, when some may not have solved the task that do.
    """
    bars, said, stops = [], [], charts.slider_stops(findings)
    for place, result in enumerate(findings.results):
        end = result.configuration.env_steps[-1].min()
        for moment, k in enumerate(stops):
            ended = bool(findings.grid[k] > end)
            values = result.final if ended or k == stops[-1] else result.seeds[k]
            finite = np.clip(values[np.isfinite(values)], borders[0], borders[-1])
            counts, _ = np.histogram(finite, borders)
            filled = np.flatnonzero(counts)
            where = {"configuration": place, "moment": moment}
            bars.append(
                where
                | {"low": short(borders[filled]), "high": short(borders[filled + 1])}
                | {"share": short(counts[filled] / len(values), 3)}
                | {"height": short(counts[filled] / max(counts.max(), 1), 3)}
            )
            said.append(where | {"said": [_said(findings, result, values, ended)]})
    return {"histogram": stacked(bars), "moments": stacked(said)}


def _said(findings: Findings, result: Result, values: np.ndarray, ended: bool) -> str:
    """Returns a configuration's label and what its seeds return, which may be its last returns."""
    label, finite = result.configuration.label, values[np.isfinite(values)]
    failed = len(values) - len(finite)
    if not len(finite):
        return f"{label}\nno seed is finite"
    text = f"{label}\n{'its end: ' if ended else ''}median {np.median(finite):,.4g}"
    text += f", worst {finite.min():,.4g}"
    if findings.experiment.threshold is not None:
        solved = int(np.sum(finite >= findings.experiment.threshold))
        text += f", {solved:,} of {len(values):,} solved"
    return text + (f", {failed:,} not finite" if failed else "")
