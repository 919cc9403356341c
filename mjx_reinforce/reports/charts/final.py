"""The final return of each configuration: a row each, best first."""

from collections.abc import Iterator

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import means, short
from mjx_reinforce.reports.experiment import counted
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.words import number, within


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart; none of one configuration alone."""
    results = findings.results
    best = results[0]
    if len(results) == 1:
        return
    ranks = list(range(len(results)))
    finals = np.concatenate([result.final for result in results])
    # Of the scores, in which a seed that failed counts as the worst, as in the means.
    tenths = np.transpose([np.quantile(result.scores, [0.1, 0.9]) for result in results])
    intervals = ", thick lines their 95% intervals" if findings.intervals else ""
    yield charts.make_chart(
        findings,
        [_rows(findings), *charts.threshold_line(findings, "x", finals)],
        42 * len(results) + 10,
        name="final",
        title="The final return",
        caption=(
            f"Points are means over seeds{intervals}, and pale bars the middle eight tenths of the "
            "seeds."
        ),
        alt=(
            f"{counted(len(results), 'row')}, best first. The best, {best.configuration.label}, is "
            f"at {number(best.mean.value)}, {within(best.mean)}. Table 1 has every number."
        ),
        data={
            "final": {
                "configuration": ranks,
                "place": ranks,
                **means(results),
                "tenth": short(tenths[0]),
                "ninetieth": short(tenths[1]),
            }
        },
    )


def _rows(findings: Findings) -> charts.Spec:
    """Returns a row of each configuration: bar, interval, point, and its label above them."""
    titles = {
        "value": "mean over seeds",
        "low": "95% from",
        "high": "to",
        "tenth": "a tenth of the seeds below",
        "ninetieth": "a tenth above",
    }
    tips = charts.tooltip(**{field: (title, ",.4~g") for field, title in titles.items()})
    # The labels stand in the rows, so there is neither a legend nor an axis of names.
    color = charts.series(findings.labels, legend=False)
    scale = {"zero": False, "padding": 12, "nice": False}
    mean = charts.quantity("value", title="final return", scale=scale)
    # From high to low: the best, at 0, is on top, with room for its label.
    y = {"axis": None, "scale": {"domain": [len(findings.results) - 0.4, -0.6]}}
    tenths = {"x": charts.quantity("tenth"), "x2": {"field": "ninetieth"}}
    interval = {"x": charts.quantity("low"), "x2": {"field": "high"}}
    label = {"x": {"value": 2}, "text": {"field": "configuration"}}
    label_style = {"align": "left", "baseline": "bottom", "dy": -9, "limit": {"expr": "width"}}
    return {
        "data": {"name": "final"},
        "encoding": {"y": charts.quantity("place", **y)},
        "layer": [
            {
                "encoding": {"color": color, "tooltip": tips},
                "layer": [
                    charts.layer("rule", tenths, strokeWidth=9, opacity=0.22, strokeCap="butt"),
                    charts.layer("rule", interval, strokeWidth=2.5),
                    charts.layer("point", {"x": mean}, filled=True, size=75, opacity=1),
                ],
            },
            charts.layer("text", label, **label_style),
        ],
    }
