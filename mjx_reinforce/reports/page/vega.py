"""What the report's charts share: their look, their scales, and how they are drawn.

Charts name a colour as a CSS variable, so that one drawing fits both grounds and print.
"""

import json
import re
from collections.abc import Sequence
from typing import Any

import altair as alt

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
#: Layers over one another.
Chart = alt.LayerChart | alt.FacetChart
#: Pixels of a configuration's name in a legend, at most.
_LABEL_LIMIT = 420
_IS_SHOWN = "indexof(shown, datum.configuration) >= 0"
_FONT = "ui-sans-serif, system-ui, 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"


def config() -> dict[str, Any]:
    """Returns how all charts look."""
    text = {"labelColor": "var(--ink)", "titleColor": "var(--soft)", "titleFontWeight": "normal"}
    sizes = {"labelFontSize": 12, "titleFontSize": 12}
    axis = {"gridColor": "var(--line)", "domainColor": "var(--soft)", "tickColor": "var(--soft)"}
    return {
        "font": _FONT,
        "background": None,
        "view": {"stroke": None},
        "axis": {**text, **sizes, **axis, "gridOpacity": 0.7, "labelOverlap": True},
        "axisX": {"grid": False, "tickCount": 6},
        "axisY": {
            "domain": False,
            "ticks": False,
            "tickCount": 5,
            "titleAlign": "left",
            "titleAngle": 0,
            "titleAnchor": "start",
            "titleY": -12,
            "titleX": 0,
        },
        "legend": {
            **text,
            **sizes,
            "symbolStrokeWidth": 2.5,
            "symbolSize": 300,
            "labelLimit": _LABEL_LIMIT,
        },
        "text": {"color": "var(--ink)", "fontSize": 12},
        "rule": {"color": "var(--soft)"},
    }


def specification(
    chart: Chart, labels: Sequence[str], shown: Sequence[str], end: float, moment: int
) -> dict[str, Any]:
    """Returns a chart as a Vega-Lite specification without its data.

    Args:
      chart: from ``charts``.
      labels: of all configurations.
      shown: of those that are shown at first.
      end: the env step, and
      moment: its number, at which the slider stands at first.
    """
    params = [
        alt.param(name="shown", value=list(shown)),
        alt.param(name="at", value=end),
        alt.param(name="moment", value=moment),
        alt.param(name="logarithmic", value=False),
    ]
    spec = chart.add_params(*params).properties(width="container").to_dict()
    return spec | {"config": config(), "autosize": {"type": "fit-x", "contains": "padding"}}


def render_chart(spec: dict[str, Any], datasets: dict[str, Any], title: str) -> dict[str, bytes]:
    """Returns a specification and its data as pictures, by the endings of their files."""
    import vl_convert

    whole = spec | {"datasets": datasets, "width": 720, "background": "var(--paper)"}
    whole["title"] = {"text": title, "anchor": "start", "color": "var(--ink)", "offset": 14}
    svg = vl_convert.vegalite_to_svg(json.loads(in_light(json.dumps(whole))))
    return {
        "png": vl_convert.svg_to_png(svg, scale=2),
        "svg": svg.encode(),
    }


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


def moment_line(end: float) -> alt.Chart:
    """Returns a line at the slider's env step, without one at the end of the axis."""
    return (
        alt.Chart(alt.NamedData("one"))
        .transform_calculate(env_steps="at")
        .transform_filter(f"datum.env_steps < {end} && datum.env_steps > 0")
        .mark_rule(strokeDash=[2, 3])
        .encode(x="env_steps:Q")
    )


def threshold_line(threshold: float | None, axis: str) -> list[alt.Chart]:
    """Returns the line at the return that counts as solved, and its name."""
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
