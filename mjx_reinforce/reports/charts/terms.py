"""The terms of the reward over the env steps, of the best configuration."""

from collections.abc import Iterator

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import Table, short, stacked
from mjx_reinforce.reports.findings import Findings, on_grid


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart; none where the reward has no terms, or a sweep did not record them."""
    names = list(findings.results[0].configuration.terms)
    if not names:
        return
    whose = f" These are of {findings.labels[0]} alone." if len(findings.labels) > 1 else ""
    yield charts.make_chart(
        findings,
        [_lines(names), charts.moment_line(findings)],
        320,
        name="terms",
        title="Terms of the reward",
        caption=(
            "What each term of the reward adds up to over an episode without exploration, the mean "
            f"over seeds.{whose} Point at a curve to read it."
        ),
        alt="Sum over an episode of each term of the reward, over env steps, a line for each term.",
        data={"terms": _sums(findings)},
        listed="terms",
    )


def _lines(names: list[str]) -> charts.Spec:
    """Returns a line for each term."""
    encoding = {
        "x": charts.STEPS,
        "y": charts.quantity("sum", title="sum over an episode"),
        "color": charts.series(names, "term"),
        "strokeDash": charts.dashes(names, "term"),
        "tooltip": [
            {"field": "term", "type": "nominal"},
            *charts.tooltip(env_steps=("env steps", ",.0f"), sum=("sum", ",.4~g"))[1:],
        ],
    }
    return {
        "data": {"name": "terms"},
        "transform": [{"filter": "!logarithmic || datum.env_steps > 0"}],
        **charts.layer("line", encoding, strokeWidth=2.2),
    }


def _sums(findings: Findings) -> Table:
    """Returns the mean over seeds of each term on the grid, up to the first seed's end."""
    best = findings.results[0].configuration
    grid = findings.grid[findings.grid <= best.env_steps[-1].min()]
    return stacked(
        {
            "configuration": 0,
            "term": name,
            "env_steps": short(grid, 7),
            "sum": short(np.mean(on_grid(grid, best.env_steps, sums), axis=1)),
        }
        for name, sums in best.terms.items()
    )
