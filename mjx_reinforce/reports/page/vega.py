"""What a chart of the report is, and what all share: their look, their scales, how they are drawn.

Charts are in Vega-Lite, through Altair. They show the configurations whose labels are in the
parameter ``shown``; the page's check boxes set it. ``at`` is the env step, and ``moment`` its
number, that the page's slider sets. They name a colour as a CSS variable, so that one drawing fits
both grounds and print.
"""

import json
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import altair as alt
import numpy as np

from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.page.columns import Table, rows

#: So many configurations are shown at first, the best.
SHOWN = 4
#: Moments that the page's slider stops at, at most.
_MOMENTS = 30

#: Okabe and Ito's colours, told apart by colour-blind people (https://jfly.uni-koeln.de/color/);
#: without their yellow, which is lost on white.
_SERIES_LIGHT = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b87a00", "#56b4e9", "#4d4d4d")
_SERIES_DARK = ("#4aa8e0", "#f2803a", "#2cc79a", "#e39cc4", "#e69f00", "#8fd0f7", "#c8c8c8")
_GROUND = {
    "light": {"paper": "#ffffff", "ink": "#1b1b1b", "soft": "#5c5c5c", "line": "#d9d9d6"},
    "dark": {"paper": "#16181b", "ink": "#ececea", "soft": "#a9abae", "line": "#3a3d42"},
}
LIGHT = _GROUND["light"] | {f"series-{i}": colour for i, colour in enumerate(_SERIES_LIGHT)}
DARK = _GROUND["dark"] | {f"series-{i}": colour for i, colour in enumerate(_SERIES_DARK)}
#: As many configurations as have a colour and a dash of their own.
SERIES = len(_SERIES_LIGHT)
#: Dashes, as lengths of strokes and gaps; not as many as colours, so that pairs repeat late.
DASHES = ([1, 0], [7, 3], [2, 2], [9, 3, 2, 3])


def colour(place: int) -> str:
    """Returns the colour of the configuration at a place."""
    return f"var(--series-{place % SERIES})"


def dash(place: int) -> list[int]:
    """Returns its dashes."""
    return DASHES[place % len(DASHES)]


def in_light(text: str) -> str:
    """Returns a text with light colours in place of the variables, for what does not know CSS."""
    return re.sub(r"var\(--([\w-]+)\)", lambda name: LIGHT[name[1]], text)


#: A data set of one row, of what is drawn once.
ONE = {"one": {"row": [0]}}
#: The env steps of a seed, along the bottom.
STEPS = alt.X(
    "env_steps:Q",
    title="env steps of a seed",
    axis=alt.Axis(labelExpr="datum.value ? format(datum.value, '~s') : '0'"),
    scale=alt.Scale(nice=False),
)
#: Pixels of a configuration's name in a legend, at most.
_LABEL_LIMIT = 420
_IS_SHOWN = "indexof(shown, datum.configuration) >= 0"
_FONT = "ui-sans-serif, system-ui, 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"


def config() -> dict[str, Any]:
    """Returns how all charts look."""
    text = {"labelColor": "var(--ink)", "titleColor": "var(--soft)", "titleFontWeight": "normal"}
    sizes = {"labelFontSize": 12, "titleFontSize": 12}
    axis = {"gridColor": "var(--line)", "domainColor": "var(--soft)", "tickColor": "var(--soft)"}
    above = {"titleAlign": "left", "titleAngle": 0, "titleAnchor": "start"}
    above |= {"titleX": 0, "titleY": -12}
    symbols = {"symbolStrokeWidth": 2.5, "symbolSize": 300}
    return {
        "font": _FONT,
        "background": None,
        "view": {"stroke": None},
        "axis": {**text, **sizes, **axis, "gridOpacity": 0.7, "labelOverlap": True},
        "axisX": {"grid": False, "tickCount": 6},
        "axisY": {"domain": False, "ticks": False, "tickCount": 5, **above},
        "legend": {**text, **sizes, **symbols, "labelLimit": _LABEL_LIMIT},
        "text": {"color": "var(--ink)", "fontSize": 12},
        "rule": {"color": "var(--soft)"},
    }


class Chart(NamedTuple):
    """A chart, what is said of it, and what it is drawn from.

    name: of its file
    number: on the page
    alt: for who cannot see it
    spec: in Vega-Lite, without data
    data: tables by name
    listed: the name of the table that the page can show, if any
    """

    name: str
    title: str
    caption: str
    alt: str
    spec: dict[str, Any]
    data: dict[str, Table]
    listed: str | None = None
    number: int = 0


def make_chart(findings: Findings, layers: Sequence[Any], height: int, **fields: Any) -> Chart:
    """Returns a chart of layers over one another.

    Args:
      findings: what it is of.
      layers: Altair's charts, the lowest first.
      height: in pixels.
      **fields: of ``Chart``, but for ``spec``.
    """
    at_first = {
        "shown": findings.labels[:SHOWN],
        "at": float(findings.grid[-1]),
        "moment": len(slider_stops(findings)) - 1,
        "logarithmic": False,
    }
    params = [alt.param(name=name, value=value) for name, value in at_first.items()]
    chart = alt.layer(*layers, height=height).add_params(*params).properties(width="container")
    spec = chart.to_dict() | {"config": config(), "description": fields["alt"]}
    spec["autosize"] = {"type": "fit-x", "contains": "padding"}
    return Chart(spec=spec, **fields)


def render_chart(chart: Chart, labels: Sequence[str], title: str) -> dict[str, bytes]:
    """Returns a chart of configurations with these labels as pictures, by their files' endings."""
    import vl_convert

    datasets = {name: rows(table, labels) for name, table in (chart.data | ONE).items()}
    whole = chart.spec | {"datasets": datasets, "width": 720, "background": "var(--paper)"}
    whole["title"] = {"text": title, "anchor": "start", "color": "var(--ink)", "offset": 14}
    svg = vl_convert.vegalite_to_svg(json.loads(in_light(json.dumps(whole))))
    return {"png": vl_convert.svg_to_png(svg, scale=2), "svg": svg.encode()}


def slider_stops(findings: Findings) -> list[int]:
    """Returns the points of the grid that the slider stops at."""
    last = len(findings.grid) - 1
    return np.unique(np.linspace(0, last, min(_MOMENTS, last + 1)).round().astype(int)).tolist()


def tooltips(**fields: tuple[str, str]) -> list[alt.Tooltip]:
    """Returns what is said of fields where one points: each one's name and its format."""
    said = fields.items()
    return [alt.Tooltip(f"{x}:Q", title=name, format=form) for x, (name, form) in said]


def shown_rows(data: str) -> alt.Chart:
    """Returns a chart of the rows that are shown; a log axis has no place for 0."""
    return (
        alt.Chart(alt.NamedData(data))
        .transform_filter(_IS_SHOWN)
        .transform_filter("!logarithmic || !(datum.env_steps <= 0)")
    )


def series(labels: Sequence[str], *, legend: bool = True) -> alt.Color:
    """Returns the colours of configurations."""
    legend = legend and len(labels) > 1
    scale = alt.Scale(domain=list(labels), range=[colour(i) for i in range(len(labels))])
    return alt.Color("configuration:N", scale=scale, legend=_legend(labels) if legend else None)


def dashes(labels: Sequence[str]) -> alt.StrokeDash:
    """Returns the dashes of configurations."""
    scale = alt.Scale(domain=list(labels), range=[dash(i) for i in range(len(labels))])
    return alt.StrokeDash(
        "configuration:N", scale=scale, legend=_legend(labels) if len(labels) > 1 else None
    )


def _legend(labels: Sequence[str]) -> alt.Legend:
    """Returns a legend in as many columns as the page has room for.

    Not as the chart has: that is narrowed to leave room for the axis once the legend is laid out.
    """
    column = min(7 * max(map(len, labels)), _LABEL_LIMIT) + 50
    return alt.Legend(
        title=None,
        orient="top",
        direction="horizontal",
        columns=alt.ExprRef(f"max(1, floor((width && containerSize()[0] || width) / {column}))"),
        values=alt.ExprRef("shown"),
        symbolType="stroke",
        offset=36,
        symbolOpacity=1,
        labelFontSize=12,
    )


def share_layers(
    findings: Findings, data: str, x: alt.X, *, title: str, tips: list[alt.Tooltip], **line: Any
) -> list[alt.Chart]:
    """Returns the band and the line of a share of the seeds; ``line`` says how they are drawn."""
    chart, axis, scale = shown_rows(data), alt.Axis(format=".0%"), alt.Scale(domain=[0, 1])
    colours = series(findings.labels)
    tips = [*tips, *tooltips(low=("95 % from", ".1%"), high=("to", ".1%"))]
    return [
        chart.mark_area(opacity=0.18, **line).encode(
            x=x, y=alt.Y("low:Q", title=title), y2="high:Q", color=colours
        ),
        chart.mark_line(strokeWidth=2.2, **line).encode(
            x=x,
            y=alt.Y("share:Q", title=title, scale=scale, axis=axis),
            color=colours,
            strokeDash=dashes(findings.labels),
            tooltip=["configuration:N", *tips],
        ),
    ]


def moment_line(findings: Findings) -> alt.Chart:
    """Returns a line at the slider's env step, without one at the end of the axis."""
    end = float(findings.grid[-1])
    return (
        alt.Chart(alt.NamedData("one"))
        .transform_calculate(env_steps="at")
        .transform_filter(f"datum.env_steps < {end} && datum.env_steps > 0")
        .mark_rule(strokeDash=[2, 3])
        .encode(x="env_steps:Q")
    )


def drawn_threshold(findings: Findings) -> float | None:
    """Returns the return that counts as solved, None where it would squeeze all that is drawn."""
    threshold = findings.experiment.threshold
    returns = np.concatenate([each.configuration.eval_return.ravel() for each in findings.results])
    known = returns[np.isfinite(returns)]
    if threshold is None or not known.size or threshold - known.max() > 0.5 * np.ptp(known):
        return None
    return threshold


def threshold_line(findings: Findings, axis: str) -> list[alt.Chart]:
    """Returns the line at the return that counts as solved, and its name."""
    threshold = drawn_threshold(findings)
    if threshold is None:
        return []
    ground = alt.Chart(alt.NamedData("one"))
    rule = ground.mark_rule(strokeDash=[6, 4], opacity=0.8)
    said, name = {axis: alt.datum(threshold)}, alt.value("solved")
    if axis == "y":  # below the line, at its end: curves come from below and end above
        text = ground.mark_text(align="right", baseline="top", dy=5, color="var(--soft)")
        text = text.encode(**said, x=alt.XValue(alt.ExprRef("width - 4")), text=name)
    else:
        text = ground.mark_text(align="right", baseline="bottom", dx=-5, color="var(--soft)")
        text = text.encode(**said, y=alt.YValue(alt.ExprRef("height - 5")), text=name)
    return [rule.encode(**said), text]
