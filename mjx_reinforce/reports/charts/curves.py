"""Learning curves: the interquartile mean and its band; of one configuration, its seeds too."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import Table, short, stacked
from mjx_reinforce.reports.findings import Findings, Result, from_the_worst, on_grid
from mjx_reinforce.reports.words import number
from mjx_reinforce.statistics import enough, iqm, iqm_interval

#: Seeds that are drawn one by one: of one configuration, and of all together.
_DRAWN_OF_ONE = 40
_DRAWN_OF_ALL = 480
_RETURN = "return of the deterministic policy"


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart."""
    threshold = findings.experiment.threshold
    returns = [result.configuration.eval_return.ravel() for result in findings.results]
    threshold_layers = charts.threshold_line(findings, "y", np.concatenate(returns))
    # Who looks for the line has to be told why there is none.
    note = ""
    if threshold is not None and not threshold_layers:
        note = f" The return that counts as solved, {number(threshold)}, lies beyond the figure."
    layers = [
        # Single seeds lie below the band, which would be hidden by hundreds of them.
        {
            "encoding": {"x": charts.STEPS, "color": charts.series(findings.labels)},
            "layer": [_lines_of_seeds(), _band_and_line(findings)],
        },
        charts.moment_line(findings),
        *threshold_layers,
    ]
    bands = _bands(findings)
    interval = ", and its 95% bootstrap interval" if charts.has_width(bands) else ""
    lines = "Thin lines are single seeds, from worst to best."
    if len(findings.results) > 1:
        # Seeds of several would cover each other: `_lines_of_seeds` draws those of one alone.
        lines = "With one configuration shown, thin lines are single seeds, from worst to best."
    yield charts.make_chart(
        findings,
        layers,
        320,
        name="curves",
        title="Learning curves",
        caption=(
            f"The interquartile mean over seeds of the return without exploration{interval}. "
            f"{lines} Point at a curve to read it.{note}"
        ),
        alt="Return over env steps, a line for each configuration that is shown.",
        data={"curves": bands, "seeds": _seeds(findings)},
        listed="curves",
    )


def picture(env: str, threshold: float | None, history: dict[str, np.ndarray]) -> bytes:
    """Returns a run's seeds, their interquartile mean and its band as a PNG file.

    Args:
      env: its id.
      threshold: the return that counts as solved, if any.
      history: ``eval_return`` and ``env_steps`` [E, S] of its evaluations.
    """
    from matplotlib.figure import Figure

    returns = history["eval_return"]
    steps = history["env_steps"]
    num_seeds = returns.shape[1]
    # The mean ends where the first seed does: beyond, it would be of other seeds.
    grid = np.linspace(0, steps[-1].min(), 200)
    curves = on_grid(grid, steps, returns)
    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.subplots()
    # The more seeds, the paler each: lines that lie on one another add up.
    opacity = max(0.03, min(0.5, 4 / num_seeds))
    axes.plot(steps, returns, color="tab:blue", linewidth=0.7, alpha=opacity)
    axes.plot(grid, iqm(curves), color="tab:blue", linewidth=2)
    title = "1 seed"
    if num_seeds > 1:
        title = f"interquartile mean of {num_seeds} seeds"
        axes.fill_between(grid, *iqm_interval(curves), color="tab:blue", alpha=0.25, linewidth=0)
    if enough(num_seeds):
        title += " and its 95% interval"
    # A threshold far away would press the curves into a corner.
    heights = returns[np.isfinite(returns)]
    if threshold is not None and heights.size and heights.min() <= threshold <= heights.max():
        axes.axhline(threshold, color="0.3", linestyle="--", linewidth=1, label="solved")
        axes.legend(frameon=False)
    axes.set(title=f"{env}: {title}", xlabel="env steps per seed", ylabel=_RETURN)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _return(field: str) -> charts.Spec:
    return charts.quantity(field, title=_RETURN, scale={"zero": False})


def _lines_of_seeds() -> charts.Spec:
    encoding = {"y": _return("value"), "detail": {"field": "seed"}}
    return {
        **charts.shown_rows("seeds", {"filter": "length(shown) == 1"}),
        **charts.layer("line", encoding, strokeWidth=0.8, opacity=0.35, clip=True),
    }


def _band_and_line(findings: Findings) -> charts.Spec:
    """Returns the interval, the mean, and its point nearest to the pointer, which says itself."""
    band = {"y": _return("low"), "y2": {"field": "high"}}
    mean_channels = {"y": _return("value"), "strokeDash": charts.dashes(findings.labels)}
    pointer = {"type": "point", "on": "pointerover", "fields": ["env_steps"], "nearest": True}
    # All points are there for the pointer to find, but only the nearest is seen.
    opacity = {"condition": {"param": "near", "empty": False, "value": 1}, "value": 0}
    # Vega-Lite leaves words out of a nearest point's tooltip, unless all data are in it.
    point_style = {"size": 70, "filled": True, "tooltip": {"content": "data"}}
    return charts.shown_rows("curves") | {
        "layer": [
            charts.layer("area", band, opacity=0.18, clip=True),
            charts.layer("line", mean_channels, strokeWidth=2.2, clip=True),
            {
                **charts.layer("point", {"y": _return("value"), "opacity": opacity}, **point_style),
                "params": [{"name": "near", "select": pointer}],
            },
        ]
    }


def _bands(findings: Findings) -> Table:
    """Returns the interquartile mean and its interval over env steps, of each configuration."""

    def band_rows(place: int, result: Result) -> dict[str, Any]:
        """Returns one configuration's, without the points at which it has no mean."""
        is_finite = np.isfinite(result.band.value)
        return {
            "configuration": place,
            "env_steps": short(findings.grid[is_finite], 7),
            **{name: short(getattr(result.band, name)[is_finite]) for name in result.band._fields},
        }

    return stacked(band_rows(place, result) for place, result in enumerate(findings.results))


def _seeds(findings: Findings) -> Table:
    """Returns some curves of each configuration: from the worst seed to the best, evenly."""
    # So many of each that a page of a large sweep stays small, but five at least.
    max_lines = max(5, min(_DRAWN_OF_ONE, _DRAWN_OF_ALL // len(findings.results)))

    def seed_rows() -> Iterator[dict[str, Any]]:
        """Yields a table of each seed that is drawn."""
        for place, result in enumerate(findings.results):
            ranked_seeds = from_the_worst(result)
            ranks = np.linspace(0, len(ranked_seeds) - 1, min(max_lines, len(ranked_seeds))).round()
            for s in ranked_seeds[np.unique(ranks).astype(int)]:
                # A curve has gaps where its seed broke, and ends at its own budget.
                is_finite = np.isfinite(result.seeds[:, s])
                yield {
                    "configuration": place,
                    "seed": int(result.configuration.seed[s]),
                    "env_steps": short(findings.grid[is_finite], 7),
                    "value": short(result.seeds[is_finite, s], 4),
                }

    return stacked(seed_rows())
