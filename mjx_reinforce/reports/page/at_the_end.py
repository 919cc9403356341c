"""The report's charts of returns: at the end, of each seed at any time, and over each setting."""

from collections.abc import Iterator
from typing import Literal

import altair as alt
import numpy as np

from mjx_reinforce.reports.experiment import Result, counted, ordered, say, setting_in_words
from mjx_reinforce.reports.findings import Findings, swept, values_of
from mjx_reinforce.reports.page import vega
from mjx_reinforce.reports.page.columns import Table, short, stacked
from mjx_reinforce.reports.page.words import number, within
from mjx_reinforce.statistics import Estimate
from mjx_reinforce.statistics.aggregates import performance_profile

#: Height of a configuration's row in the histograms, in pixels.
ROW = 66
#: Bars of a histogram, and points of a profile, at most.
_BARS, _MOST_POINTS = 36, 80
_INTERVAL = {"low": "95 % from", "high": "to"}


def final(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the final return of each configuration, a row each, best first; not of one alone."""
    results = findings.results
    if len(results) == 1:
        return
    rows, colours = alt.Chart(alt.NamedData("final")), vega.series(findings.labels, legend=False)
    y = alt.Y("place:Q", axis=None, scale=alt.Scale(domain=[len(results) - 0.4, -0.6]))
    x = alt.X("value:Q", title="return at the end", scale=alt.Scale(zero=False, padding=12))
    tenths = {"tenth": "a tenth of the seeds below", "ninetieth": "a tenth above"}
    names = {"value": "mean over seeds", **_INTERVAL, **tenths}
    tips = vega.tooltips(**{field: (name, ",.4~g") for field, name in names.items()})
    look = {"y": y, "color": colours, "tooltip": ["configuration:N", *tips]}
    layers = [
        rows.mark_rule(strokeWidth=9, opacity=0.22, strokeCap="butt").encode(
            x=alt.X("tenth:Q"), x2="ninetieth:Q", **look
        ),
        rows.mark_rule(strokeWidth=2.5).encode(x=alt.X("low:Q"), x2="high:Q", **look),
        rows.mark_point(filled=True, size=75, opacity=1).encode(x=x, **look),
        rows.mark_text(align="left", baseline="bottom", dy=-9, limit=alt.ExprRef("width")).encode(
            x=alt.value(2), y=y, text="configuration:N"
        ),
        *vega.threshold_line(findings, "x"),
    ]
    spread = np.transpose([np.quantile(each.scores, [0.1, 0.9]) for each in results])
    best = results[0]
    yield vega.make_chart(
        findings,
        layers,
        42 * len(results) + 10,
        name="final",
        title="The return at the end",
        caption=(
            "Points are means over seeds, thick lines their 95 % intervals, and pale bars the "
            "middle eight tenths of the seeds."
        ),
        alt=(
            f"{counted(len(results), 'row')}, best first. The best, {best.configuration.label}, is "
            f"at {number(best.mean.value)}, {within(best.mean)}. Table 1 has every number."
        ),
        data={
            "final": {
                "configuration": list(range(len(results))),
                "place": list(range(len(results))),
                **_means(results),
                "tenth": short(spread[0]),
                "ninetieth": short(spread[1]),
            }
        },
    )


def _means(results: list[Result]) -> Table:
    return {x: short([getattr(each.mean, x) for each in results]) for x in Estimate._fields}


def distribution(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the returns of all seeds at a moment, a histogram for each configuration."""
    borders = _borders(findings)
    row = "length(shown) - 1 - indexof(shown, datum.configuration)"
    scale = alt.Scale(domain=[0, alt.ExprRef("length(shown)")], nice=False)
    y = alt.Y("base:Q", axis=None, scale=scale)
    x_scale = alt.Scale(domain=[float(borders[0]), float(borders[-1])], nice=False)
    histogram, moments = (
        vega.shown_rows(data).transform_filter("datum.moment == moment")
        for data in ("histogram", "moments")
    )
    ends = {"low": ("return from", ",.0f"), "high": ("to", ",.0f")}
    tips = vega.tooltips(**ends, share=("share of seeds", ".1%"))
    bars = (
        histogram.transform_calculate(base=row, top="datum.base + 0.5 * datum.height")
        .mark_bar(opacity=0.85, binSpacing=0)
        .encode(
            x=alt.X("low:Q", title="return", scale=x_scale),
            x2="high:Q",
            y=y,
            y2="top:Q",
            color=vega.series(findings.labels, legend=False),
            tooltip=["configuration:N", *tips],
        )
    )
    said = moments.transform_calculate(base=row, top="datum.base + 0.92")
    text = said.mark_text(
        align="left", baseline="top", lineBreak="\n", lineHeight=15, limit=alt.ExprRef("width")
    ).encode(x=alt.value(2), y=alt.Y("top:Q", axis=None, scale=scale), text="said:N")
    ground = said.mark_rule(opacity=0.6).encode(x=alt.value(0), x2=alt.value("width"), y=y)
    yield vega.make_chart(
        findings,
        [ground, bars, text],
        ROW * len(findings.labels[: vega.SHOWN]),
        name="distribution",
        title="Where the seeds are",
        caption=(
            "Histograms of all seeds' returns, read off at the slider's time; its last place, "
            "and what had ended before, is each seed's last evaluation, as in table 1. The "
            "tallest bar of each row has its height, and the outermost bars hold what lies "
            "beyond them."
        ),
        alt="A histogram of returns for each configuration shown, with its median and worst.",
        data=_histograms(findings, borders),
    )


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
    bars, said, stops = [], [], vega.slider_stops(findings)
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


def profile(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the share of seeds whose final return is above each return."""
    finals = np.concatenate([each.final for each in findings.results])
    finals = finals[np.isfinite(finals)]
    thresholds = (
        np.linspace(finals.min(), finals.max(), _MOST_POINTS) if finals.size else np.zeros(1)
    )
    x = alt.X("threshold:Q", title="return at the end", scale=alt.Scale(nice=False))
    tips = vega.tooltips(threshold=("return", ",.1f"), share=("seeds above", ".1%"))
    layers = vega.share_layers(findings, "profile", x, title="seeds above it", tips=tips)
    shares = [performance_profile(each.final, thresholds) for each in findings.results]
    yield vega.make_chart(
        findings,
        [*layers, *vega.threshold_line(findings, "x")],
        320,
        name="profile",
        title="Performance profiles",
        caption=(
            "The share of seeds that end above each return, with Wilson's 95 % interval. A "
            "curve above another everywhere is better whatever return one asks for."
        ),
        alt="Share of seeds over the final return, a falling line for each configuration.",
        data={
            "profile": stacked(
                {
                    "configuration": place,
                    "threshold": short(thresholds),
                    "share": short(share.value, 4),
                    "low": short(share.low, 4),
                    "high": short(share.high, 4),
                }
                for place, share in enumerate(shares)
            )
        },
        listed="profile",
    )


def sensitivity(findings: Findings) -> Iterator[vega.Chart]:
    """Yields the mean final return over the values of each setting.

    Configurations that differ in this setting alone are joined by a line.
    """
    y = alt.Y("value:Q", title="mean return at the end", scale=alt.Scale(zero=False, padding=8))
    low = alt.Y("low:Q", title=y["title"])
    paint = alt.condition("datum.best", alt.value("var(--series-0)"), alt.value("var(--soft)"))
    clear = alt.condition("datum.best", alt.value(1), alt.value(0.55))
    width = alt.condition("datum.best", alt.value(2.6), alt.value(1))
    names = {"value": "mean return", **_INTERVAL}
    tips = vega.tooltips(**{field: (name, ",.1f") for field, name in names.items()})
    for n, name in enumerate(swept(findings)):
        data, said = f"sensitivity-{n}", setting_in_words(name)
        chart, x = alt.Chart(alt.NamedData(data)), _setting_axis(findings, name)
        look = {"x": x, "color": paint, "opacity": clear}
        layers = [
            chart.mark_line().encode(y=y, detail="others:N", strokeWidth=width, **look),
            chart.mark_rule(strokeWidth=2).encode(y=low, y2="high:Q", **look),
            chart.mark_point(filled=True, size=60).encode(
                y=y, tooltip=["configuration:N", *tips], **look
            ),
        ]
        yield vega.make_chart(
            findings,
            layers,
            220,
            name=data,
            title=said,
            caption="",
            alt=f"Mean return at the end over {said}; table 1 has the numbers.",
            data={data: _means_by_setting(findings, name)},
        )


def _kind_of_axis(findings: Findings, name: str) -> Literal["log", "linear", "ordinal"]:
    values = values_of(findings, name)
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        return "ordinal"
    low, high = min(values), max(values)
    return "log" if low > 0 and high / low >= 8 else "linear"


def _setting_axis(findings: Findings, name: str) -> alt.X:
    """Returns the axis for a setting, with its name in words."""
    kind, values = _kind_of_axis(findings, name), ordered(values_of(findings, name))
    title = setting_in_words(name)
    if kind == "ordinal":
        return alt.X("setting:O", title=title, sort=None, axis=alt.Axis(labelAngle=0))
    axis = alt.Axis(values=values, format="~g") if len(values) <= 8 else alt.Axis()
    zero = alt.Undefined if kind == "log" else False
    scale = alt.Scale(type=kind, padding=14, nice=False, zero=zero)
    return alt.X("setting:Q", title=title, scale=scale, axis=axis)


def _means_by_setting(findings: Findings, name: str) -> Table:
    """Returns the final return over the values of a setting, in their order."""
    values = values_of(findings, name)
    places = {repr(x): n for n, x in enumerate(ordered(values))}
    order = sorted(range(len(values)), key=lambda i: places[repr(values[i])])
    results = [findings.results[i] for i in order]
    others = [
        tuple((k, repr(v)) for k, v in each.configuration.settings.items() if k != name)
        for each in results
    ]
    best = others[order.index(0)]
    numbers = {other: n for n, other in enumerate(dict.fromkeys(others))}
    ordinal = _kind_of_axis(findings, name) == "ordinal"
    return {
        "configuration": order,
        "setting": [say(values[i]) if ordinal else values[i] for i in order],
        **_means(results),
        "others": [numbers[other] for other in others],
        "best": [other == best for other in others],
    }
