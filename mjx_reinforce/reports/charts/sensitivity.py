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
        # Numbered, because the name of a setting need not be an identifier.
        table = f"sensitivity-{n}"
        title = setting_in_words(name)
        yield charts.make_chart(
            findings,
            [_lines(table, _axis(findings, name))],
            220,
            name=table,
            title=title,
            # The page has one caption for all settings.
            caption="",
            alt=f"Mean final return over {title}; table 1 has the numbers.",
            data={table: _means_by_setting(findings, name)},
        )


def _lines(data: str, x: charts.Spec) -> charts.Spec:
    """Returns the means and their intervals; those that agree with the best stand out."""

    def if_best(value: object, other_value: object) -> charts.Spec:
        return {"condition": {"test": "datum.best", "value": value}, "value": other_value}

    title = "mean final return"
    value = charts.quantity("value", title=title, scale={"zero": False, "padding": 8})
    interval = {"y": charts.quantity("low", title=title), "y2": {"field": "high"}}
    titles = {"value": "mean return", "low": "95% from", "high": "to"}
    tips = charts.tooltip(**{field: (name, ",.1f") for field, name in titles.items()})
    # ``others`` is a number of the values of all other settings: a line for each.
    line = {"y": value, "detail": {"field": "others"}, "strokeWidth": if_best(2.6, 1)}
    line_color = if_best("var(--series-0)", "var(--soft)")
    return {
        "data": {"name": data},
        "encoding": {"x": x, "color": line_color, "opacity": if_best(1, 0.55)},
        "layer": [
            charts.layer("line", line),
            charts.layer("rule", interval, strokeWidth=2),
            charts.layer("point", {"y": value, "tooltip": tips}, filled=True, size=60),
        ],
    }


def _kind_of_axis(findings: Findings, name: str) -> Literal["log", "linear", "ordinal"]:
    """Returns the kind of axis for the values of a setting."""
    values = values_of(findings, name)
    # True is an int in Python, but no number to read off an axis.
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        return "ordinal"
    # Values that reach so far, as 1, 3 and 10 do, were chosen by their ratios.
    low = min(values)
    return "log" if low > 0 and max(values) / low >= 8 else "linear"


def _axis(findings: Findings, name: str) -> charts.Spec:
    """Returns the axis for a setting, with its name in words."""
    kind = _kind_of_axis(findings, name)
    values = ordered(values_of(findings, name))
    title = setting_in_words(name)
    if kind == "ordinal":
        axis = {"labelAngle": 0}
        return {"field": "setting", "type": "ordinal", "title": title, "sort": None, "axis": axis}
    # A tick at each value, as long as their labels do not run into each other.
    axis = {"values": values, "format": "~g"} if len(values) <= 8 else {}
    scale = {"type": kind, "padding": 14, "nice": False}
    if kind == "linear":
        scale["zero"] = False
    return charts.quantity("setting", title=title, scale=scale, axis=axis)


def _means_by_setting(findings: Findings, name: str) -> Table:
    """Returns the final return over the values of a setting, in their order."""
    values = values_of(findings, name)
    # By ``repr``: values may be lists, which cannot be keys of a dict.
    places = {repr(x): n for n, x in enumerate(ordered(values))}
    order = sorted(range(len(values)), key=lambda i: places[repr(values[i])])
    results = [findings.results[i] for i in order]
    settings = [values[i] for i in order]
    if _kind_of_axis(findings, name) == "ordinal":
        settings = [say(value) for value in settings]
    # Configurations of the same context differ in this setting alone: a line joins them.
    contexts = [
        tuple((k, repr(v)) for k, v in result.configuration.settings.items() if k != name)
        for result in results
    ]
    context_numbers = {context: n for n, context in enumerate(dict.fromkeys(contexts))}
    best = contexts[order.index(0)]
    return {
        "configuration": order,
        "setting": settings,
        **means(results),
        "others": [context_numbers[context] for context in contexts],
        "best": [context == best for context in contexts],
    }
