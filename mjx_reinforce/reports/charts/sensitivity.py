"""The mean final return over the values of each setting.

Configurations that differ in this setting alone are joined by a line.
"""

from collections.abc import Iterator
from typing import Literal

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import Table, means
from mjx_reinforce.reports.experiment import ordered, say, setting_in_words
from mjx_reinforce.reports.findings import Findings, swept, values_of


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields a chart of each setting that differs."""
    for n, name in enumerate(swept(findings)):
        data, said = f"sensitivity-{n}", setting_in_words(name)
        yield charts.make_chart(
            findings,
            [_lines(data, _axis(findings, name))],
            220,
            name=data,
            title=said,
            caption="",
            alt=f"Mean final return over {said}; table 1 has the numbers.",
            data={data: _means_by_setting(findings, name)},
        )


def _lines(data: str, x: charts.Spec) -> charts.Spec:
    """Returns the means and their intervals; those that agree with the best stand out."""

    def if_best(one: object, other: object) -> charts.Spec:
        return {"condition": {"test": "datum.best", "value": one}, "value": other}

    title = "mean final return"
    value = charts.quantity("value", title=title, scale={"zero": False, "padding": 8})
    interval = {"y": charts.quantity("low", title=title), "y2": {"field": "high"}}
    said = {"value": "mean return", "low": "95% from", "high": "to"}
    tips = charts.tooltip(**{field: (name, ",.1f") for field, name in said.items()})
    joined = {"y": value, "detail": {"field": "others"}, "strokeWidth": if_best(2.6, 1)}
    paint = if_best("var(--series-0)", "var(--soft)")
    return {
        "data": {"name": data},
        "encoding": {"x": x, "color": paint, "opacity": if_best(1, 0.55)},
        "layer": [
            charts.layer("line", joined),
            charts.layer("rule", interval, strokeWidth=2),
            charts.layer("point", {"y": value, "tooltip": tips}, filled=True, size=60),
        ],
    }


def _kind_of_axis(findings: Findings, name: str) -> Literal["log", "linear", "ordinal"]:
    values = values_of(findings, name)
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        return "ordinal"
    low, high = min(values), max(values)
    return "log" if low > 0 and high / low >= 8 else "linear"


def _axis(findings: Findings, name: str) -> charts.Spec:
    """Returns the axis for a setting, with its name in words."""
    kind, values = _kind_of_axis(findings, name), ordered(values_of(findings, name))
    title = setting_in_words(name)
    if kind == "ordinal":
        axis = {"labelAngle": 0}
        return {"field": "setting", "type": "ordinal", "title": title, "sort": None, "axis": axis}
    axis = {"values": values, "format": "~g"} if len(values) <= 8 else {}
    zero = {} if kind == "log" else {"zero": False}
    scale = {"type": kind, "padding": 14, "nice": False, **zero}
    return charts.quantity("setting", title=title, scale=scale, axis=axis)


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
        **means(results),
        "others": [numbers[other] for other in others],
        "best": [other == best for other in others],
    }
