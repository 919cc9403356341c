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
    borders = _borders(findings)
    # What a lone configuration cannot do is not said: end earlier, or be compared with a row.
    earlier = ""
    heights = ""
    if len(findings.results) > 1:
        earlier = ", and where a configuration ended earlier,"
        heights = " The tallest bar of each row has the same height."
    # With one stop the page has no slider.
    moment = ":"
    if len(charts.slider_stops(findings)) > 1:
        moment = (
            " at the slider's time. Before its end, a dotted line marks that time in the curves. "
            f"At its end{earlier} they show"
        )
    yield charts.make_chart(
        findings,
        [_labels(), _bars(findings, borders)],
        ROW * len(findings.labels[: charts.SHOWN]),
        name="distribution",
        title="Where the seeds are",
        caption=(
            f"Histograms of all seeds' returns{moment} each seed's last evaluation, as in table 1."
            f"{heights} The outermost bars include what lies beyond them."
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
    text = {"x": {"value": 2}, "y": charts.quantity("top", **_Y), "text": {"field": "said"}}
    look = {"align": "left", "baseline": "top", "lineBreak": "\n", "lineHeight": 15}
    # The text hangs from a little below the row's upper border, at 1.
    return _at_the_moment("moments", "0.92") | {
        "layer": [
            charts.layer("rule", ground, opacity=0.6),
            charts.layer("text", text, limit={"expr": "width"}, **look),
        ]
    }


def _bars(findings: Findings, borders: np.ndarray) -> charts.Spec:
    """Returns the bars, which stand on the ground of their row and fill half of it at most."""
    ends = {"domain": [float(borders[0]), float(borders[-1])], "nice": False}
    encoding = {
        "x": charts.quantity("low", title="return", scale=ends),
        "x2": {"field": "high"},
        "y": charts.quantity("base", **_Y),
        "y2": {"field": "top"},
        "color": charts.series(findings.labels, legend=False),
        "tooltip": charts.tooltip(
            low=("return from", ",.0f"),
            high=("to", ",.0f"),
            share=("share of seeds", ".1%"),
        ),
    }
    # The other half of a row is for its two lines of text.
    return {
        **_at_the_moment("histogram", "0.5 * datum.height"),
        **charts.layer("bar", encoding, opacity=0.85, binSpacing=0),
    }


def _borders(findings: Findings) -> np.ndarray:
    """Returns the edges of the histograms' bars; what is beyond counts in the outer ones."""
    values = np.concatenate([result.seeds.ravel() for result in findings.results])
    values = values[np.isfinite(values)]
    if not values.size:
        return np.linspace(0.0, 1.0, _BARS + 1)
    # One seed in a thousand may lie far out, and would squeeze all others into one bar.
    low, high = np.quantile(values, [0.001, 0.999])
    if low == high:
        return np.linspace(low - 0.5, high + 0.5, _BARS + 1)
    return np.linspace(low, high, _BARS + 1)


def _histograms(findings: Findings, borders: np.ndarray) -> dict[str, Table]:
    """Returns the histograms of all configurations at all moments, and what is said of each.

    The last moment is the end: each seed's last evaluation, which tables are of. The grid ends
    where the first seed did, when some may not have solved the task that do.
    """
    bars = []
    texts = []
    stops = charts.slider_stops(findings)
    for place, result in enumerate(findings.results):
        end = result.configuration.env_steps[-1].min()
        for moment, k in enumerate(stops):
            ended = bool(findings.grid[k] > end)
            values = result.final if ended or k == stops[-1] else result.seeds[k]
            # Clipped, so that what lies beyond the borders is in the outermost bars.
            finite = np.clip(values[np.isfinite(values)], borders[0], borders[-1])
            counts, _ = np.histogram(finite, borders)
            # Bars without seeds are not written: they are most of all rows.
            filled = np.flatnonzero(counts)
            row = {"configuration": place, "moment": moment}
            bars.append(
                {
                    **row,
                    "low": short(borders[filled]),
                    "high": short(borders[filled + 1]),
                    "share": short(counts[filled] / len(values), 3),
                    # Over the tallest of its own row, so that every row uses its height.
                    "height": short(counts[filled] / max(counts.max(), 1), 3),
                }
            )
            texts.append({**row, "said": [_row_text(findings, result, values, ended)]})
    return {"histogram": stacked(bars), "moments": stacked(texts)}


def _row_text(findings: Findings, result: Result, values: np.ndarray, ended: bool) -> str:
    """Returns a configuration's label and what its seeds return, which may be its last returns."""
    finite = values[np.isfinite(values)]
    text = f"{result.configuration.label}\n"
    if not len(finite):
        return f"{text}no seed is finite"
    if ended:
        text += "its end: "
    text += f"median {np.median(finite):,.4g}, worst {finite.min():,.4g}"
    if findings.experiment.threshold is not None:
        # Of all seeds, as in table 1: one that failed has not solved the task.
        solved = int(np.sum(finite >= findings.experiment.threshold))
        text += f", {solved:,} of {len(values):,} solved"
    if len(finite) < len(values):
        text += f", {len(values) - len(finite):,} not finite"
    return text
