"""The report as one HTML page that needs nothing but itself."""

import datetime
import json
import math
from collections.abc import Mapping
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from mjx_reinforce.reports import charts, words
from mjx_reinforce.reports.charts import (
    curves,
    distribution,
    final,
    sensitivity,
    solved,
    terms,
)
from mjx_reinforce.reports.experiment import Experiment, counted, say, setting_in_words
from mjx_reinforce.reports.findings import COMPARED, Findings
from mjx_reinforce.reports.listings import listings
from mjx_reinforce.reports.tasks import TaskFindings, draw_profile
from mjx_reinforce.reports.words import steps
from mjx_reinforce.statistics import enough

#: The charts in the order of the page.
_CHARTS = (final, curves, solved, terms, distribution, sensitivity)
_TEMPLATES = resources.files("mjx_reinforce.reports") / "files"


def draw_charts(findings: Findings) -> list[charts.Chart]:
    """Returns the charts that show something, numbered; those of all settings as one."""
    numbered_charts: list[charts.Chart] = []
    number = 1
    for module in _CHARTS:
        filled_charts = [
            chart
            for chart in module.draw(findings)
            if any(table["configuration"] for table in chart.data.values())
        ]
        numbered_charts += [chart._replace(number=number) for chart in filled_charts]
        # A kind without charts leaves no gap in the numbers; one with several is one figure.
        number += bool(filled_charts)
    return numbered_charts


def render(
    findings: Findings,
    drawn: list[charts.Chart],
    results: str,
    watch: str,
    version: str,
    seconds: float,
) -> str:
    """Returns the page.

    Args:
      findings: the figures.
      drawn: its charts.
      results: ``results.csv``.
      watch: the command that shows the worst seed, if its policy was kept.
      version: of this program.
      seconds: how long the report has taken so far.
    """
    import vl_convert

    stops = charts.short(findings.grid[charts.slider_stops(findings)], 7)
    content = {
        "labels": findings.labels,
        "specs": {figure.name: figure.spec for figure in drawn},
        "tables": {name: table for figure in drawn for name, table in figure.data.items()},
        "moments": stops,
        "results": results,
        "row": distribution.ROW,
        "light": charts.LIGHT,
    }
    return _template("page.html").render(
        **_text(findings, drawn),
        **provenance_rows(findings.experiment),
        watch=watch,
        moments=stops,
        date=_today(),
        version=version,
        seconds=f"{seconds:.1f} s",
        findings=findings,
        charts=charts,
        words=words,
        css=Markup(_read_template("page.css")),
        script=Markup(_read_template("page.js")),
        vega_bundle=Markup(vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")),
        content=Markup(_json(content)),
    )


def _today() -> str:
    """Returns the date, "29 November 2026"."""
    return f"{datetime.date.today():%d %B %Y}".lstrip("0")


def _template(name: str) -> jinja2.Template:
    """Returns a template of a page."""
    # Labels and paths are other people's text: all is escaped but what ``Markup`` exempts.
    loader = jinja2.Environment(
        loader=jinja2.FunctionLoader(_read_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return loader.get_template(name)


def _read_template(name: str) -> str:
    return (_TEMPLATES / name).read_text(encoding="utf-8")


def _json(value: object) -> str:
    """Returns JSON that cannot end the script element that it is in."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def encoded(text: str) -> bytes:
    """Returns UTF-8, with escapes for bytes of a path that a locale of ASCII cannot read."""
    return text.encode(errors="backslashreplace")


def _text(findings: Findings, drawn: list[charts.Chart]) -> dict[str, Any]:
    """Returns the text of the page, without the provenance of its numbers."""
    figures = {figure.name: figure for figure in drawn}
    sensitivity = [figure for figure in drawn if figure.name.startswith("sensitivity-")]
    tables = listings(findings)
    # A chart that shows nothing is None, so that the template can ask for it.
    chart_names = ("final", "curves", "solved", "terms", "distribution")
    failures = any(not math.isfinite(x) for result in findings.results for x in result.final)
    return {
        "answer": words.headline(findings),
        "distrust": list(words.caveats(findings)),
        "figures": {name: figures.get(name) for name in chart_names},
        "failures": failures,
        "several": len(findings.results) > 1,
        "few": not all(enough(len(result.final)) for result in findings.results),
        "solved": findings.experiment.threshold is not None and words.solved(findings.experiment),
        "two_ways": words.two_ways(findings),
        "pairs": counted(len(findings.comparisons), "pair"),
        "listed": tables,
        "until": steps(findings.until),
        "numbers": {name: place for place, name in enumerate(tables, start=1)},
        "sensitivity": sensitivity,
        "lost": words.lost(findings),
        "compared": COMPARED,
    }


#: What the name of an entry of the provenance would not tell.
_ENTRY_NAMES = {"git_commit": "last commit of the package's files"}


def provenance_rows(experiment: Experiment) -> dict[str, Any]:
    """Returns where the numbers come from, as pairs of names and values."""
    # Each directory once, in the order in which they were named: a sweep has many configurations.
    directories = list(dict.fromkeys(map(str, experiment.directories)))
    facts = [("read from", ", ".join(directories))]
    facts += [
        (name.replace("_seconds", " time").replace("_", " "), f"{seconds:,.1f} s")
        for name, seconds in experiment.timings.items()
    ]
    facts += [
        (_ENTRY_NAMES.get(name) or setting_in_words(name), _in_words(value))
        for name, value in experiment.provenance.items()
        if value not in (None, "", [])
    ]
    settings = [(setting_in_words(name), say(value)) for name, value in experiment.settings.items()]
    return {"facts": facts, "settings": settings}


def _in_words(value: object) -> str:
    """Returns an entry of the provenance in words."""
    if isinstance(value, Mapping):
        # None is what was not known, such as the commit of a folder without git.
        return "; ".join(
            f"{setting_in_words(key)} {_in_words(entry)}"
            for key, entry in value.items()
            if entry is not None
        )
    if isinstance(value, list):
        return ", ".join(map(_in_words, value))
    return say(value)


def render_tasks(findings: TaskFindings, picture: bytes, pages: list[str], version: str) -> str:
    """Returns the page of several tasks.

    Args:
      findings: the figures.
      picture: the profile as SVG.
      pages: the addresses of the tasks' own pages, from this one.
      version: of this program.
    """
    return _template("tasks.html").render(
        findings=findings,
        charts=charts,
        tasks=[*zip(findings.tasks, findings.scales, pages, strict=True)],
        answer=[*words.over_tasks(findings)],
        profile=draw_profile(findings),
        picture=Markup(picture.decode()),
        score=words.score,
        number=words.number,
        interval=lambda estimate: words.interval_in_words(estimate, words.score),
        date=_today(),
        version=version,
        css=Markup(_read_template("page.css")),
    )
