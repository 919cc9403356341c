"""The report's figures: each chart with its caption, and the names of its data."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.reports.experiment import counted, ordered, setting_in_words
from mjx_reinforce.reports.findings import Findings, swept, values_of
from mjx_reinforce.reports.page import charts, tables
from mjx_reinforce.reports.page.distributions import edges, slider_stops
from mjx_reinforce.reports.page.vega import Chart, specification
from mjx_reinforce.reports.page.words import number, within

#: So many configurations are shown at first, the best.
SHOWN = 4


class Figure(NamedTuple):
    """A chart and what is said of it.

    name: of its file
    number: on the page
    alt: for who cannot see it
    spec: in Vega-Lite, without data
    tables: the names of its data, which can be downloaded
    hidden: those of data that can be found elsewhere
    listed: the one that the page can show as a table, if any
    """

    name: str
    number: int
    title: str
    caption: str
    alt: str
    spec: dict[str, Any]
    tables: list[str]
    listed: str | None = None
    hidden: tuple[str, ...] = ()


def figures(findings: Findings) -> list[Figure]:
    """Returns the figures in the order of the page, numbered; several may share a number."""
    made: list[Figure] = []
    first = _final_figure, _curves_figure, _solved_figure, _distribution, _profile_figure
    for build in (*first, _sensitivity, _worst_figure):
        made += [*build(findings, made[-1].number + 1 if made else 1)]
    return made


def _figure(findings: Findings, chart: Chart, **fields: Any) -> Figure:
    labels, last = findings.labels, len(slider_stops(findings)) - 1
    spec = specification(chart, labels, labels[:SHOWN], float(findings.grid[-1]), last)
    spec["description"] = fields["alt"]
    return Figure(spec=spec, **fields)


def _line(findings: Findings) -> float | None:
    """Returns the return that counts as solved, None where it would squeeze all that is drawn."""
    threshold = findings.experiment.threshold
    returns = np.concatenate([each.configuration.eval_return.ravel() for each in findings.results])
    known = returns[np.isfinite(returns)]
    if threshold is None or not known.size or threshold - known.max() > 0.5 * np.ptp(known):
        return None
    return threshold


def _beyond(findings: Findings) -> str:
    threshold = findings.experiment.threshold
    if threshold is None or _line(findings) is not None:
        return ""
    return f" The return that counts as solved, {number(threshold)}, lies above the figure."


def _final_figure(findings: Findings, place: int) -> Iterator[Figure]:
    if len(findings.results) == 1:
        return
    best = findings.results[0]
    yield _figure(
        findings,
        charts.final(findings.labels, _line(findings)),
        name="final",
        number=place,
        title="The return at the end",
        caption=(
            "Points are means over seeds, thick lines their 95 % intervals, and pale bars the "
            "middle eight tenths of the seeds."
        ),
        alt=(
            f"{counted(len(findings.results), 'row')}, best first. The best, "
            f"{best.configuration.label}, is at {number(best.mean.value)}, {within(best.mean)}. "
            "Table 1 has every number."
        ),
        tables=["final"],
    )


def _curves_figure(findings: Findings, place: int) -> Iterator[Figure]:
    drawn = "; with one configuration shown, thin lines are single seeds, from worst to best"
    yield _figure(
        findings,
        charts.curves(findings.labels, _line(findings), float(findings.grid[-1])),
        name="curves",
        number=place,
        title="Learning curves",
        caption=(
            "The interquartile mean over seeds of the return without exploration, and its 95 % "
            f"bootstrap interval{drawn}. The dotted line is the "
            f"slider's time below. Point at a curve to read it.{_beyond(findings)}"
        ),
        alt="Return over env steps, a line and a band for each configuration that is shown.",
        tables=["curves", "seeds"],
        listed="curves",
    )


def _solved_figure(findings: Findings, place: int) -> Iterator[Figure]:
    solved = any(each.solving and each.solving.ever for each in findings.results)
    if findings.experiment.threshold is None or not solved:
        return
    yield _figure(
        findings,
        charts.solved(findings.labels, float(findings.grid[-1])),
        name="solved",
        number=place,
        title="How many have solved it",
        caption=(
            f"The share of seeds that have reached {number(findings.experiment.threshold)} at "
            "least once, after Kaplan and Meier, with its pointwise 95 % interval. A seed that "
            "fell back later still counts here; table 1 says how many did. The curve's last "
            "point is the end of each seed's training."
        ),
        alt="Share of seeds over env steps, a rising line for each configuration shown.",
        tables=["solved"],
        listed="solved",
    )


def _distribution(findings: Findings, place: int) -> Iterator[Figure]:
    borders = edges(findings)
    yield _figure(
        findings,
        charts.distribution(findings.labels[:SHOWN], float(borders[0]), float(borders[-1])),
        name="distribution",
        number=place,
        title="Where the seeds are",
        caption=(
            "Histograms of all seeds' returns, read off at the slider's time; its last place, "
            "and what had ended before, is each seed's last evaluation, as in table 1. The "
            "tallest bar of each row has its height, and the outermost bars hold what lies "
            "beyond them."
        ),
        alt="A histogram of returns for each configuration shown, with its median and worst.",
        tables=["histogram", "moments"],
    )


def _profile_figure(findings: Findings, place: int) -> Iterator[Figure]:
    yield _figure(
        findings,
        charts.profile(findings.labels, _line(findings)),
        name="profile",
        number=place,
        title="Performance profiles",
        caption=(
            "The share of seeds that end above each return, with Wilson's 95 % interval. A "
            "curve above another everywhere is better whatever return one asks for."
        ),
        alt="Share of seeds over the final return, a falling line for each configuration.",
        tables=["profile"],
        listed="profile",
    )


def _sensitivity(findings: Findings, place: int) -> Iterator[Figure]:
    for n, name in enumerate(swept(findings)):
        kind, values = tables.axis_of(findings, name), values_of(findings, name)
        chart = charts.sensitivity(
            setting_in_words(name), f"sensitivity-{n}", kind, ordered(values)
        )
        said = f"Mean return at the end over {setting_in_words(name)}; table 1 has the numbers."
        yield _figure(
            findings,
            chart,
            name=f"sensitivity-{n}",
            number=place,
            title=setting_in_words(name),
            caption="",
            alt=said,
            tables=[f"sensitivity-{n}"],
        )


def _worst_figure(findings: Findings, place: int) -> Iterator[Figure]:
    best = findings.results[0]
    shown = len(tables.worst_seeds(best))
    which = "worst seed" if shown == 1 else f"worst {shown} seeds"
    yield _figure(
        findings,
        charts.worst(_line(findings)),
        name="worst",
        number=place,
        title=f"The {which} of {best.configuration.label}",
        caption="Thin lines, with a point for each evaluation; thick: the interquartile mean.",
        alt="Returns over env steps of the worst seeds; the table below says how each ended.",
        tables=["worst"],
        listed="worst",
        hidden=("band",),
    )
