"""The report as one HTML page that needs nothing but itself."""

import datetime
import json
import math
from collections.abc import Mapping
from importlib import resources
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from mjx_reinforce.reports.experiment import count, say, spoken
from mjx_reinforce.reports.findings import COMPARED, Findings, Result
from mjx_reinforce.reports.page import charts, palette, tables, vega, words
from mjx_reinforce.reports.page.columns import Table, short
from mjx_reinforce.reports.page.distributions import moments
from mjx_reinforce.reports.page.figures import SHOWN, Figure
from mjx_reinforce.reports.page.words import interval, number, percent, steps

_FILES = resources.files("mjx_reinforce.reports.page") / "files"
_METHODS = (
    "Configurations are ordered by the mean of their seeds' final returns; where means are equal, "
    "by the env steps to solve.",
    "Intervals are of 95 %, over seeds, and each holds alone, not all at once: of means and "
    "interquartile means by the expanded percentile bootstrap (Hesterberg 2015), of the worst "
    "tenth by the bootstrap t, of shares after Wilson.",
    "The interquartile mean leaves out the worst and the best quarter of the seeds (Agarwal et "
    "al. 2021, arXiv:2108.13264); a seed that is not finite is worse than every other.",
    "Env steps to solve are those of the first evaluation at or above the threshold; a seed that "
    "never got there is censored, not left out (Kaplan and Meier 1958).",
    "Pairs are compared seed by seed, and p values corrected for their number (Holm 1979).",
    "Curves are read off, by linear interpolation, at the same env steps for all seeds, up to the "
    "end of the shortest.",
)


class Watch(NamedTuple):
    """How to see a seed for oneself: what to do, and the command."""

    said: str
    command: str


def render(
    findings: Findings,
    drawn: list[Figure],
    chart_tables: Mapping[str, Table],
    files: Mapping[str, str],
    watch: Watch,
    version: str,
    seconds: float,
) -> str:
    """Returns the page.

    Args:
      findings: the figures.
      drawn: the charts.
      chart_tables: their data, by name.
      files: texts that can be downloaded, by name.
      watch: how to see the worst seed.
      version: of this program.
      seconds: how long the report has taken so far.
    """
    import vl_convert

    loader = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_unbroken,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = loader.from_string(_read("page.html"))
    content = {
        "labels": _labels(findings),
        "specs": {figure.name: figure.spec for figure in drawn},
        "tables": {**chart_tables, **vega.ONE},
        "moments": short(findings.grid[moments(findings)], 7),
        "files": files,
        "row": charts.ROW,
        "light": palette.LIGHT,
    }
    return template.render(
        **_text(findings, drawn),
        **_provenance(findings),
        watch=watch,
        files=[(name, _size(text)) for name, text in files.items()],
        moments=content["moments"],
        version=version,
        seconds=f"{seconds:.1f} s",
        light=palette.LIGHT,
        dark=palette.DARK,
        colour=palette.colour,
        dash=palette.dash,
        css=Markup(_read("page.css")),
        script=Markup(_read("page.js")),
        vega_bundle=Markup(vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")),
        content=Markup(_json(content)),
    )


def _read(name: str) -> str:
    return (_FILES / name).read_text(encoding="utf-8")


def _unbroken(value: Any) -> Any:
    """Returns a text in which no line breaks "95 %" and "p = 0.01", and anything else as it is."""
    if type(value) is not str:
        return value
    for broken in (" %", "p = ", "p < "):
        value = value.replace(broken, broken.replace(" ", "\u00a0"))
    return value


def _json(value: Any) -> str:
    """Returns JSON that cannot end the script element that it is in."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def encoded(text: str) -> bytes:
    """Returns UTF-8, with escapes for bytes of a path that a locale of ASCII cannot read."""
    return text.encode(errors="backslashreplace")


def _size(text: str) -> str:
    size = len(encoded(text))
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(1, round(size / 1e3))} kB"


def _labels(findings: Findings) -> list[str]:
    return [each.configuration.label for each in findings.results]


def _text(findings: Findings, drawn: list[Figure]) -> dict[str, Any]:
    """Returns what the template says, but for where it comes from."""
    figures = {figure.name: figure for figure in drawn}
    sensitivity = [figure for figure in drawn if figure.name.startswith("sensitivity-")]
    matrix = _matrix(findings)
    contents = [
        *(("answer", "Answer"), ("distrust", "What to distrust"), ("results", "Results")),
        *(("curves", "Learning curves"), ("distribution", "All seeds")),
        *([("pairs", "Pair by pair")] if matrix else []),
        *([("settings", "Each setting")] if sensitivity else []),
        *(("worst", "The worst seeds"), ("source", "Where this comes from"), ("data", "Data")),
    ]
    names = ("final", "curves", "solved", "distribution", "profile", "worst")
    failures = any(not math.isfinite(x) for each in findings.results for x in each.final)
    return {
        "title": findings.experiment.title,
        "asked": findings.experiment.asked,
        "date": datetime.date.today().strftime("%-d %B %Y"),
        "contents": contents,
        "answer": words.answer(findings),
        "key_figures": _key_figures(findings),
        "distrust": words.distrust(findings),
        "figures": {name: figures.get(name) for name in names},
        "failures": failures,
        "summary": _summary(findings),
        "labels": _labels(findings),
        "first_shown": SHOWN,
        "matrix": matrix,
        "pairs": count(len(findings.comparisons), "pair"),
        "level": words.LEVEL,
        "against": _against(findings),
        "sensitivity": sensitivity,
        "worst": [_fate(findings, findings.results[0], s) for s in _worst(findings.results[0])],
        "others_worst": [
            _fate(findings, each, tables.worst_seeds(each)[0])
            for each in findings.results[1:COMPARED]
        ],
        "methods": _METHODS,
    }


def _worst(result: Result) -> list[int]:
    return tables.worst_seeds(result).tolist()


def _key_figures(findings: Findings) -> list[tuple[str, str, str]]:
    """Returns the few numbers that stand out: name, value, what is below."""
    best = findings.results[0]
    seeds = sum(len(each.final) for each in findings.results)
    ends = max(int(each.configuration.env_steps[-1].max()) for each in findings.results)
    found = [
        ("seeds trained", f"{seeds:,}", count(len(findings.results), "configuration")),
        ("return of the best", number(best.mean.value), interval(best.mean)),
    ]
    if (solving := best.solving) is not None:
        said = f"of {len(best.final):,}; {interval(solving.rate, percent)}"
        found.append(("its seeds solved", f"{solving.at_end:,}", said))
        until = steps(solving.median.value)
        found.append(("env steps until half", until, interval(solving.median, steps)))
    else:
        found.append(("worst tenth", number(best.tail.value), interval(best.tail)))
    found.append(("env steps a seed", f"{ends:,}", "at most"))
    return found


def _summary(findings: Findings) -> dict[str, Any]:
    """Returns table 1."""
    header = ["", "configuration", "seeds", "mean", "interquartile mean", "worst tenth"]
    solving = findings.experiment.threshold is not None
    if solving:
        header += ["solved at the end", "steps until half solved", "fell back"]
    header += ["not finite"]
    listed = []
    for each in findings.results:
        cells = [(f"{len(each.final):,}", "")]
        for estimate in (each.mean, each.iqm, each.tail):
            cells.append((number(float(estimate.value)), interval(estimate)))
        if each.solving is not None:
            share = f"{each.solving.at_end:,} of {len(each.final):,}"
            median = each.solving.median
            cells.append((share, interval(each.solving.rate, percent)))
            cells.append((steps(median.value), interval(median, steps)))
            cells.append((f"{int(each.solving.fell.sum()):,}", ""))
        cells.append((f"{sum(not math.isfinite(x) for x in each.final):,}", ""))
        listed.append({"label": each.configuration.label, "cells": cells})
    return {"header": header, "rows": listed}


def _matrix(findings: Findings) -> list[dict[str, Any]]:
    """Returns table 2: a row for each configuration, a cell for each, None on the diagonal."""
    if not findings.comparisons:
        return []
    labels = _labels(findings)[:COMPARED]
    cells: list[list[Any]] = [[None] * len(labels) for _ in labels]
    for pair in findings.comparisons:
        sure = pair.adjusted < words.LEVEL
        for i, j, share in (
            (pair.first, pair.second, float(pair.improvement.value)),
            (pair.second, pair.first, 1 - float(pair.improvement.value)),
        ):
            cells[i][j] = {
                "text": f"{100 * share:.0f}",
                "sure": sure,
                "tint": 0 if share >= 0.5 else 1,
                "strength": f"{min(0.45, 0.9 * abs(share - 0.5)):.2f}",
                "title": f"{labels[i]} against {labels[j]}: {percent(share)}; "
                f"{words.p_value(pair.adjusted)}",
            }
    return [{"label": label, "cells": row} for label, row in zip(labels, cells, strict=True)]


def _against(findings: Findings) -> list[dict[str, Any]]:
    """Returns table 3."""
    return [
        {
            "label": findings.results[pair.second].configuration.label,
            "cells": [
                (number(float(pair.difference.value)), interval(pair.difference)),
                (percent(float(pair.improvement.value)), interval(pair.improvement, percent)),
                (words.p_value(pair.p_value).removeprefix("p = ").removeprefix("p "), ""),
                (words.p_value(pair.adjusted).removeprefix("p = ").removeprefix("p "), ""),
            ],
        }
        for pair in words.of_best(findings)
    ]


def _fate(findings: Findings, result: Result, s: int) -> dict[str, Any]:
    return {
        "seed": int(result.configuration.seed[s]),
        "label": result.configuration.label,
        "value": number(float(result.final[s])) if math.isfinite(result.final[s]) else "not finite",
        "fate": words.fate(findings, result, s),
    }


def _provenance(findings: Findings) -> dict[str, Any]:
    """Returns where the numbers come from, as pairs of names and values."""
    experiment = findings.experiment
    directories = list(dict.fromkeys(map(str, experiment.directories)))
    facts = [("read from", ", ".join(directories))]
    facts += [
        (name.replace("_seconds", " time").replace("_", " "), f"{seconds:,.1f} s")
        for name, seconds in experiment.timings.items()
    ]
    facts += [
        (spoken(name), _plain(value))
        for name, value in experiment.provenance.items()
        if value not in (None, "", [])
    ]
    settings = [(spoken(name), say(value)) for name, value in experiment.settings.items()]
    return {"facts": facts, "settings": settings}


def _plain(value: Any) -> str:
    """Returns an entry of the provenance in words."""
    if isinstance(value, Mapping):
        listed = ((spoken(key), _plain(x)) for key, x in value.items() if x is not None)
        return "; ".join(f"{key} {said}" for key, said in listed)
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    return say(value)
