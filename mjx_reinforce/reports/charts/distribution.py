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
    end_note = ""
    height_note = ""
    if len(findings.results) > 1:
        end_note = ", and where a configuration ended earlier,"
        height_note = " The tallest bar of each row has the same height."
    # With one stop the page has no slider.
    moment_note = ":"
    if len(charts.slider_stops(findings)) > 1:
        moment_note = (
            " at the slider's time. Before its end, a dotted line marks that time in the curves. "
            f"At its end{end_note} they show"
        )
    yield charts.make_chart(
        findings,
        [_labels(), _bars(findings, borders)],
        ROW * len(findings.labels[: charts.SHOWN]),
        name="distribution",
        title="Where the seeds are",
        caption=(
            f"Histograms of all seeds' returns{moment_note} each seed's last evaluation, as in "
            f"table 1.{height_note} The outermost bars include what lies beyond them."
        ),
        alt="A histogram of returns for each configuration shown, with its median and worst.",
        data=_histograms(findings, borders),
    )


#: Rows lie on one another, the best on top.
_Y = {"axis": None, "scale": {"domain": [0, {"expr": "length(shown)"}], "nice": False}}


def _at_the_moment(data: str, top: str) -> charts.Spec:
    """Returns the rows of a moment, with the ground of each one's row and how high it reaches."""
    row_number = "length(shown) - 1 - indexof(shown, datum.configuration)"
    return charts.shown_rows(
        data,
        {"filter": "datum.moment == moment"},
        {"calculate": row_number, "as": "base"},
        {"calculate": f"datum.base + {top}", "as": "top"},
    )


def _labels() -> charts.Spec:
    """Returns the ground of each row and, at its top, what is said of it."""
    baseline = {"x": {"value": 0}, "x2": {"value": "width"}, "y": charts.quantity("base", **_Y)}
    text = {"x": {"value": 2}, "y": charts.quantity("top", **_Y), "text": {"field": "said"}}
    label_style = {"align": "left", "baseline": "top", "lineBreak": "\n", "lineHeight": 15}
    # The text hangs from a little below the row's upper border, at 1.
    return _at_the_moment("moments", "0.92") | {
        "layer": [
            charts.layer("rule", baseline, opacity=0.6),
            charts.layer("text", text, limit={"expr": "width"}, **label_style),
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
    returns = np.concatenate([result.seeds.ravel() for result in findings.results])
    returns = returns[np.isfinite(returns)]
    if not returns.size:
        return np.linspace(0.0, 1.0, _BARS + 1)
    # One seed in a thousand may lie far out, and would squeeze all others into one bar.
    low, high = np.quantile(returns, [0.001, 0.999])
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
            has_ended = bool(findings.grid[k] > end)
            returns = result.final if has_ended or k == stops[-1] else result.seeds[k]
            # Clipped, so that what lies beyond the borders is in the outermost bars.
            finite_returns = np.clip(returns[np.isfinite(returns)], borders[0], borders[-1])
            counts, _ = np.histogram(finite_returns, borders)
            # Bars without seeds are not written: they are most of all rows.
            filled_bins = np.flatnonzero(counts)
            row = {"configuration": place, "moment": moment}
            bars.append(
                {
                    **row,
                    "low": short(borders[filled_bins]),
                    "high": short(borders[filled_bins + 1]),
                    "share": short(counts[filled_bins] / len(returns), 3),
                    # Over the tallest of its own row, so that every row uses its height.
                    "height": short(counts[filled_bins] / max(counts.max(), 1), 3),
                }
            )
            texts.append({**row, "said": [_row_text(findings, result, returns, has_ended)]})
    return {"histogram": stacked(bars), "moments": stacked(texts)}


def _row_text(findings: Findings, result: Result, returns: np.ndarray, has_ended: bool) -> str:
    """Returns a configuration's label and what its seeds return, which may be its last returns."""
    finite_returns = returns[np.isfinite(returns)]
    text = f"{result.configuration.label}\n"
    if not len(finite_returns):
        return f"{text}no seed is finite"
    if has_ended:
        text += "its end: "
    text += f"median {np.median(finite_returns):,.4g}, worst {finite_returns.min():,.4g}"
    if findings.experiment.threshold is not None:
        # Of all seeds, as in table 1: one that failed has not solved the task.
        num_solved = int(np.sum(finite_returns >= findings.experiment.threshold))
        text += f", {num_solved:,} of {len(returns):,} solved"
    if len(finite_returns) < len(returns):
        text += f", {len(returns) - len(finite_returns):,} not finite"
    return text
