"""The charts of the report, a file each, and what all share: look, scales, how they are drawn.

``draw`` of a file yields a chart, or none where there is nothing to show. Charts are in Vega-Lite,
see https://vega.github.io/vega-lite/docs/. They show the configurations whose labels are in the
parameter ``shown``; the page's check boxes set it. ``at`` is the env step, and ``moment`` its
number, that the page's slider sets. They name a color as a CSS variable, so that one drawing fits
both grounds and print.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_reinforce.reports.findings import Findings, Result
from mjx_reinforce.statistics import Estimate

#: A part of a specification.
Spec = dict[str, Any]
#: Columns by name, all of one length. ``configuration`` holds places among the results.
Table = dict[str, list[Any]]

#: So many configurations are shown at first, the best.
SHOWN = 4
#: Moments that the page's slider stops at, at most.
_MOMENTS = 30

_LOOK = json.loads(
    (resources.files("mjx_reinforce.reports") / "files" / "look.json").read_text("utf-8")
)
#: Colors by name. Those of the configurations are Okabe and Ito's, told apart by color-blind
#: people (https://jfly.uni-koeln.de/color/), without their yellow, which is lost on white.
LIGHT = _LOOK["light"]
DARK = _LOOK["dark"]
#: How all charts look, for Vega-Lite.
CONFIG = _LOOK["config"]
_NUM_COLORS = sum(name.startswith("series-") for name in LIGHT)


def color(place: int) -> str:
    """Returns the color of the configuration at a place."""
    return f"var(--series-{place % _NUM_COLORS})"


def dash(place: int) -> list[int]:
    """Returns its dashes, as lengths of strokes and gaps.

    They are not as many as colors, so that pairs repeat late.
    """
    return _LOOK["dashes"][place % len(_LOOK["dashes"])]


def in_light(text: str) -> str:
    """Returns a text with light colors in place of the variables, for what does not know CSS."""
    return re.sub(r"var\(--([\w-]+)\)", lambda name: LIGHT[name[1]], text)


def quantity(field: str, **properties: Any) -> Spec:
    """Returns a channel that shows a number, with further properties of the channel."""
    return {"field": field, "type": "quantitative", **properties}


def layer(mark: str, encoding: Spec, **look: Any) -> Spec:
    """Returns a layer of marks of a kind, how they look, and what they show."""
    return {"mark": {"type": mark, **look}, "encoding": encoding}


#: The env steps of a seed, along the bottom.
STEPS = quantity(
    "env_steps",
    title="env steps per seed",
    axis={"labelExpr": "datum.value ? format(datum.value, '~s') : '0'"},
    scale={"nice": False},
)
_CONFIGURATION = {"field": "configuration", "type": "nominal"}
#: Data of one row, of what is drawn once.
_ONCE = {"values": [{}]}


def rows(table: Table, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Returns a table row by row, with the labels of its configurations."""
    columns = list(table)
    records = [dict(zip(columns, row, strict=True)) for row in zip(*table.values(), strict=True)]
    # Tables hold places, so that a page has each label, which may be long, only once.
    if "configuration" in table:
        return [row | {"configuration": labels[row["configuration"]]} for row in records]
    return records


#: Floats beyond have no fractions.
_SHORT = 2.0**53


def short(values: ArrayLike, digits: int = 5) -> list[Any]:
    """Returns numbers with a few digits, None where they are not finite."""
    return [_short_number(x, digits) for x in np.asarray(values, float).ravel().tolist()]


def _short_number(value: float, digits: int) -> float | int | None:
    """Returns a number with a few digits, as an int where it is whole, None for NaN."""
    # JSON has neither NaN nor infinity; Vega-Lite leaves a mark out where a value is null.
    if not math.isfinite(value):
        return None
    rounded = float(f"{value:.{digits}g}")
    # The drawing program reads no int beyond 64 bits.
    if rounded.is_integer() and abs(rounded) < _SHORT:
        return int(rounded)
    return rounded


def means(results: Sequence[Result]) -> Table:
    """Returns the mean final return of results, and the ends of its interval."""
    return {
        field: short([getattr(result.mean, field) for result in results])
        for field in Estimate._fields
    }


def stacked(tables: Iterable[Mapping[str, Any]]) -> Table:
    """Returns tables below each other; what is no list in one is the same in all of its rows."""
    table: Table = {}
    for part in tables:
        # Every part has one list at least, which says how many rows its constants fill.
        length = next(len(x) for x in part.values() if isinstance(x, list))
        for name, values in part.items():
            if not isinstance(values, list):
                values = [values] * length
            table.setdefault(name, []).extend(values)
    return table


def has_width(bands: Table) -> bool:
    """Returns whether a band of a table is anywhere to be seen."""
    ends = zip(bands["low"], bands["high"], strict=True)
    return any(None not in (low, high) and low < high for low, high in ends)


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
    spec: Spec
    data: dict[str, Table]
    listed: str | None = None
    number: int = 0


def make_chart(findings: Findings, layers: Sequence[Spec], height: int, **fields: Any) -> Chart:
    """Returns a chart of layers over one another.

    Args:
      findings: what it is of.
      layers: the lowest first.
      height: in pixels.
      **fields: of ``Chart``, but for ``spec``.
    """
    # The page's controls set these parameters. Their values here are what a picture shows, and the
    # page before anybody touches it: the best few, at the end.
    parameters = {
        "shown": findings.labels[:SHOWN],
        "at": float(findings.grid[-1]),
        "moment": len(slider_stops(findings)) - 1,
        "logarithmic": False,
    }
    spec = {
        "$schema": "https://vega.github.io/schema/vega-lite/v6.json",
        "description": fields["alt"],
        "config": CONFIG,
        "params": [{"name": name, "value": value} for name, value in parameters.items()],
        "width": "container",
        "height": height,
        # The page's figures are as wide as the window: only the width follows.
        "autosize": {"type": "fit-x", "contains": "padding"},
        "layer": layers,
    }
    return Chart(spec=spec, **fields)


def render_chart(chart: Chart, labels: Sequence[str], title: str) -> dict[str, bytes]:
    """Returns a chart of configurations with these labels as pictures, by their files' endings."""
    import vl_convert

    datasets = {name: rows(table, labels) for name, table in chart.data.items()}
    # A file stands by itself: it has its data, a width in pixels, a title and a ground.
    spec = chart.spec | {"datasets": datasets, "width": 720, "background": "var(--paper)"}
    spec["title"] = {"text": title, "anchor": "start", "color": "var(--ink)", "offset": 14}
    svg = vl_convert.vegalite_to_svg(json.loads(in_light(json.dumps(spec))))
    # Two pixels for each of the drawing's, for screens and print that are finer.
    return {"png": vl_convert.svg_to_png(svg, scale=2), "svg": svg.encode()}


def slider_stops(findings: Findings) -> list[int]:
    """Returns the points of the grid that the slider stops at."""
    last = len(findings.grid) - 1
    return np.unique(np.linspace(0, last, min(_MOMENTS, last + 1)).round().astype(int)).tolist()


def tooltip(**fields: tuple[str, str]) -> list[Spec]:
    """Returns what is said where one points: the configuration, and fields by name and format."""
    channels = [
        quantity(field, title=title, format=form) for field, (title, form) in fields.items()
    ]
    return [_CONFIGURATION, *channels]


def shown_rows(data: str, *transforms: Spec) -> Spec:
    """Returns the rows that are shown, before further transforms; a log axis has no place for 0."""
    filters = [
        {"filter": "indexof(shown, datum.configuration) >= 0"},
        # Not `> 0`: a table without env steps has no value to compare, and keeps its rows.
        {"filter": "!logarithmic || !(datum.env_steps <= 0)"},
    ]
    return {"data": {"name": data}, "transform": [*filters, *transforms]}


def series(labels: Sequence[str], field: str = "configuration", *, legend: bool = True) -> Spec:
    """Returns the colors of configurations, or of what else a field has."""
    return _by_place(field, labels, [color(i) for i in range(len(labels))], legend=legend)


def dashes(labels: Sequence[str], field: str = "configuration") -> Spec:
    """Returns the dashes of configurations, or of what else a field has."""
    return _by_place(field, labels, [dash(i) for i in range(len(labels))])


def _by_place(
    field: str, labels: Sequence[str], looks: Sequence[Any], *, legend: bool = True
) -> Spec:
    """Returns how a field's labels look, each by its place, and a legend of several.

    It has as many columns as the page has room for. Not as the chart has: that is narrowed to leave
    room for the axis once the legend is laid out.
    """
    legend_spec = None
    if legend and len(labels) > 1:
        # A letter is about 7 pixels wide; 50 more hold the stroke and the gap to the next column.
        column_width = min(7 * max(map(len, labels)), CONFIG["legend"]["labelLimit"]) + 50
        num_columns = f"max(1, floor((width && containerSize()[0] || width) / {column_width}))"
        legend_spec = {"title": None, "orient": "top", "direction": "horizontal", "offset": 36}
        legend_spec |= {"columns": {"expr": num_columns}}
        if field == "configuration":
            legend_spec |= {"values": {"expr": "shown"}}
        legend_spec |= {"symbolType": "stroke", "symbolOpacity": 1, "labelFontSize": 12}
    scale = {"domain": list(labels), "range": list(looks)}
    return {"field": field, "type": "nominal", "scale": scale, "legend": legend_spec}


def moment_line(findings: Findings) -> Spec:
    """Returns a line at the slider's env step, without one at the end of the axis."""
    end = float(findings.grid[-1])
    return {
        "data": _ONCE,
        "transform": [
            {"calculate": "at", "as": "env_steps"},
            # At 0 a logarithmic axis could not draw it either.
            {"filter": f"datum.env_steps < {end} && datum.env_steps > 0"},
        ],
        **layer("rule", {"x": quantity("env_steps")}, strokeDash=[2, 3]),
    }


def threshold_line(findings: Findings, axis: str, drawn_returns: np.ndarray) -> list[Spec]:
    """Returns the line at the return that counts as solved, and its name.

    There is none beyond the returns that are drawn: axes end where the data do.
    """
    threshold = findings.experiment.threshold
    heights = drawn_returns[np.isfinite(drawn_returns)]
    if threshold is None or not heights.size or not heights.min() <= threshold <= heights.max():
        return []
    # Below the line, at its end: curves come from below and end above.
    position = {"x": {"value": {"expr": "width - 4"}}}
    label_style = {"baseline": "top", "dy": 5}
    if axis == "x":
        position = {"y": {"value": {"expr": "height - 5"}}}
        label_style = {"baseline": "bottom", "dx": -5}
    rule = {"mark": {"type": "rule", "strokeDash": [6, 4], "opacity": 0.8}}
    label_encoding = {**position, "text": {"value": "solved"}}
    label = layer("text", label_encoding, align="right", color="var(--soft)", **label_style)
    return [{"data": _ONCE, "encoding": {axis: {"datum": threshold}}, "layer": [rule, label]}]
