"""The report's charts in Vega-Lite, through Altair. Their data are named, and come in with them.

Each chart shows the configurations whose labels are in the parameter ``shown``; the page's check
boxes set it. ``at`` is the env step, and ``moment`` its number, that the page's slider sets.
"""

from collections.abc import Sequence
from typing import Any, Literal

import altair as alt

from mjx_reinforce.reports.page.vega import (
    Chart,
    dashes,
    moment_line,
    series,
    shown_rows,
    threshold_line,
)

#: Height of a configuration's row, in pixels.
ROW = 66
_HEIGHT = 320
_STEPS_TITLE = "env steps of a seed"
_THOUSANDS = alt.Axis(labelExpr="datum.value ? format(datum.value, '~s') : '0'")


def curves(labels: Sequence[str], threshold: float | None, end: float) -> Chart:
    """Interquartile mean and band over env steps; of one configuration, its seeds too.

    Data: ``curves`` (configuration, env_steps, value, low, high), ``seeds`` (configuration,
    seed, env_steps, value).
    """
    x = alt.X("env_steps:Q", title=_STEPS_TITLE, axis=_THOUSANDS, scale=alt.Scale(nice=False))
    y = alt.Y("value:Q", title="return of the deterministic policy", scale=alt.Scale(zero=False))
    shown = shown_rows("curves")
    near = alt.selection_point(
        name="near", on="pointerover", fields=["env_steps"], nearest=True, empty=False
    )
    seeds = shown_rows("seeds").transform_filter("length(shown) == 1")
    layers = [
        seeds.mark_line(strokeWidth=0.8, opacity=0.35, clip=True).encode(
            x=x, y=y, detail="seed:N", color=series(labels)
        ),
        shown.mark_area(opacity=0.18, clip=True).encode(
            x=x, y=alt.Y("low:Q", title=y["title"]), y2="high:Q", color=series(labels)
        ),
        shown.mark_line(strokeWidth=2.2, clip=True).encode(
            x=x, y=y, color=series(labels), strokeDash=dashes(labels)
        ),
        moment_line(end),
        # Vega-Lite leaves words out of a nearest point's tooltip, unless all data are in it.
        shown.mark_point(size=70, filled=True, tooltip=alt.TooltipContent("data"))
        .encode(
            x=x,
            y=y,
            color=series(labels),
            opacity=alt.condition(near, alt.value(1), alt.value(0)),
        )
        .add_params(near),
    ]
    return alt.layer(*layers, *threshold_line(threshold, "y"), height=_HEIGHT)


def final(labels: Sequence[str], threshold: float | None) -> Chart:
    """The final return of each configuration, a row each, best first.

    Data: ``final`` (configuration, place, value, low, high, tenth, ninetieth).
    """
    rows = alt.Chart(alt.NamedData("final"))
    y = alt.Y("place:Q", axis=None, scale=alt.Scale(domain=[len(labels) - 0.4, -0.6]))
    x = alt.X("value:Q", title="return at the end", scale=alt.Scale(zero=False, padding=12))
    colours = series(labels, legend=False)
    tips = [
        "configuration:N",
        alt.Tooltip("value:Q", title="mean over seeds", format=",.4~g"),
        alt.Tooltip("low:Q", title="95 % from", format=",.4~g"),
        alt.Tooltip("high:Q", title="to", format=",.4~g"),
        alt.Tooltip("tenth:Q", title="a tenth of the seeds below", format=",.4~g"),
        alt.Tooltip("ninetieth:Q", title="a tenth above", format=",.4~g"),
    ]
    layers = [
        rows.mark_rule(strokeWidth=9, opacity=0.22, strokeCap="butt").encode(
            x=alt.X("tenth:Q"), x2="ninetieth:Q", y=y, color=colours, tooltip=tips
        ),
        rows.mark_rule(strokeWidth=2.5).encode(
            x=alt.X("low:Q"), x2="high:Q", y=y, color=colours, tooltip=tips
        ),
        rows.mark_point(filled=True, size=75, opacity=1).encode(
            x=x, y=y, color=colours, tooltip=tips
        ),
        rows.mark_text(align="left", baseline="bottom", dy=-9, limit=alt.ExprRef("width")).encode(
            x=alt.value(2), y=y, text="configuration:N"
        ),
    ]
    height = 42 * len(labels) + 10
    return alt.layer(*layers, *threshold_line(threshold, "x"), height=height)


def distribution(labels: Sequence[str], low: float, high: float) -> Chart:
    """The returns of all seeds at a moment, a row for each configuration.

    Data: ``histogram`` (configuration, moment, low, high, share, height) and ``moments``
    (configuration, moment, said).
    """
    row = "length(shown) - 1 - indexof(shown, datum.configuration)"
    of_moment = "datum.moment == moment"
    scale = alt.Scale(domain=[0, alt.ExprRef("length(shown)")], nice=False)
    y = alt.Y("base:Q", axis=None, scale=scale)
    x_scale = alt.Scale(domain=[low, high], nice=False)
    bars = (
        shown_rows("histogram")
        .transform_filter(of_moment)
        .transform_calculate(base=row, top="datum.base + 0.5 * datum.height")
        .mark_bar(opacity=0.85, binSpacing=0)
        .encode(
            x=alt.X("low:Q", title="return", scale=x_scale),
            x2="high:Q",
            y=y,
            y2="top:Q",
            color=series(labels, legend=False),
            tooltip=[
                "configuration:N",
                alt.Tooltip("low:Q", title="return from", format=",.0f"),
                alt.Tooltip("high:Q", title="to", format=",.0f"),
                alt.Tooltip("share:Q", title="share of seeds", format=".1%"),
            ],
        )
    )
    said = (
        shown_rows("moments")
        .transform_filter(of_moment)
        .transform_calculate(base=row, top="datum.base + 0.92")
    )
    text = said.mark_text(
        align="left", baseline="top", lineBreak="\n", lineHeight=15, limit=alt.ExprRef("width")
    ).encode(x=alt.value(2), y=alt.Y("top:Q", axis=None, scale=scale), text="said:N")
    ground = said.mark_rule(opacity=0.6).encode(x=alt.value(0), x2=alt.value("width"), y=y)
    return alt.layer(ground, bars, text, height=ROW * len(labels))


def solved(labels: Sequence[str], end: float) -> Chart:
    """The share of seeds that have solved the task, over env steps.

    Data: ``solved`` (configuration, env_steps, share, low, high).
    """
    x = alt.X("env_steps:Q", title=_STEPS_TITLE, axis=_THOUSANDS, scale=alt.Scale(nice=False))
    tips = [
        alt.Tooltip("env_steps:Q", title="env steps", format=",.0f"),
        alt.Tooltip("share:Q", title="have solved", format=".1%"),
    ]
    title = "seeds that have solved the task"
    layers = _shares("solved", labels, x, title, tips, interpolate="step-after")
    return alt.layer(*layers, moment_line(end), height=_HEIGHT)


def profile(labels: Sequence[str], threshold: float | None) -> Chart:
    """The share of seeds whose final return is above each return.

    Data: ``profile`` (configuration, threshold, share, low, high).
    """
    x = alt.X("threshold:Q", title="return at the end", scale=alt.Scale(nice=False))
    tips = [
        alt.Tooltip("threshold:Q", title="return", format=",.1f"),
        alt.Tooltip("share:Q", title="seeds above", format=".1%"),
    ]
    layers = _shares("profile", labels, x, "seeds above it", tips)
    return alt.layer(*layers, *threshold_line(threshold, "x"), height=_HEIGHT)


def _shares(
    data: str, labels: Sequence[str], x: alt.X, title: str, tips: list[alt.Tooltip], **line: Any
) -> tuple[alt.Chart, alt.Chart]:
    """Returns the band and the line of a share of the seeds; ``line`` says how they are drawn."""
    chart, axis, scale = shown_rows(data), alt.Axis(format=".0%"), alt.Scale(domain=[0, 1])
    y = alt.Y("share:Q", title=title, scale=scale, axis=axis)
    bounds = [alt.Tooltip("low:Q", title="95 % from", format=".1%")]
    bounds.append(alt.Tooltip("high:Q", title="to", format=".1%"))
    band = chart.mark_area(opacity=0.18, **line).encode(
        x=x, y=alt.Y("low:Q", title=title), y2="high:Q", color=series(labels)
    )
    tooltip = ["configuration:N", *tips, *bounds]
    drawn = chart.mark_line(strokeWidth=2.2, **line).encode(
        x=x, y=y, color=series(labels), strokeDash=dashes(labels), tooltip=tooltip
    )
    return band, drawn


def sensitivity(
    name: str, data: str, kind: Literal["log", "linear", "ordinal"], values: Sequence[Any]
) -> Chart:
    """The mean final return over the values of one setting.

    Configurations that differ in this setting alone are joined by a line.

    Args:
      name: of the setting, in words.
      data: name of its data (value, setting, low, high, others, best).
      kind: of its axis, "log", "linear" or "ordinal".
      values: that were tried, for the axis.
    """
    chart = alt.Chart(alt.NamedData(data))
    if kind == "ordinal":
        x = alt.X("setting:O", title=name, sort=None, axis=alt.Axis(labelAngle=0))
    else:
        axis = alt.Axis(values=list(values), format="~g") if len(values) <= 8 else alt.Axis()
        zero = alt.Undefined if kind == "log" else False
        scale = alt.Scale(type=kind, padding=14, nice=False, zero=zero)
        x = alt.X("setting:Q", title=name, scale=scale, axis=axis)
    y = alt.Y("value:Q", title="mean return at the end", scale=alt.Scale(zero=False, padding=8))
    paint = alt.condition("datum.best", alt.value("var(--series-0)"), alt.value("var(--soft)"))
    clear = alt.condition("datum.best", alt.value(1), alt.value(0.55))
    tips = [
        "configuration:N",
        alt.Tooltip("value:Q", title="mean return", format=",.1f"),
        alt.Tooltip("low:Q", title="95 % from", format=",.1f"),
        alt.Tooltip("high:Q", title="to", format=",.1f"),
    ]
    width = alt.condition("datum.best", alt.value(2.6), alt.value(1))
    line = chart.mark_line().encode(
        x=x, y=y, detail="others:N", color=paint, opacity=clear, strokeWidth=width
    )
    bars = chart.mark_rule(strokeWidth=2).encode(
        x=x, y=alt.Y("low:Q", title=y["title"]), y2="high:Q", color=paint, opacity=clear
    )
    points = chart.mark_point(filled=True, size=60).encode(
        x=x, y=y, color=paint, opacity=clear, tooltip=tips
    )
    return alt.layer(line, bars, points, height=220)


def worst(threshold: float | None) -> Chart:
    """The worst seeds of the best configuration, over its band.

    Data: ``worst`` (configuration, seed, env_steps, value), ``band`` (configuration, env_steps,
    value).
    """
    x = alt.X("env_steps:Q", title=_STEPS_TITLE, axis=_THOUSANDS, scale=alt.Scale(nice=False))
    y = alt.Y("value:Q", title="return of the deterministic policy", scale=alt.Scale(zero=False))
    band = alt.Chart(alt.NamedData("band"))
    seeds = alt.Chart(alt.NamedData("worst"))
    layers = [
        band.mark_line(strokeWidth=2.2, color="var(--series-0)").encode(x=x, y=y),
        seeds.mark_line(
            strokeWidth=1.2, color="var(--series-1)", point={"size": 14, "color": "var(--series-1)"}
        ).encode(
            x=x,
            y=y,
            detail="seed:N",
            tooltip=[
                "seed:N",
                alt.Tooltip("env_steps:Q", title="env steps", format=",.0f"),
                alt.Tooltip("value:Q", title="return", format=",.1f"),
            ],
        ),
    ]
    return alt.layer(*layers, *threshold_line(threshold, "y"), height=260)
