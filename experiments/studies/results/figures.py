"""The pictures of docs/results.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.results.files import Result
from experiments.studies.results.runs import FACTOR
from experiments.studies.results.tables import moved_measure
from experiments.studies.results.tasks import PUBLISHED_STEPS
from mjx_reinforce.reports.experiment import setting_in_words

#: Colours that differ for colour-blind readers too (Okabe and Ito 2008), and shapes.
_COLOURS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#999999"),
    *("#882255", "#117733"),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_COLUMNS = 4


def draw(results: Sequence[Result], folder: Path) -> None:
    """Draws the learning curves, and what moved settings do where they were swept."""
    folder.mkdir(parents=True, exist_ok=True)
    swept = [result for result in results if result.moved is not None]
    for name, figure in {
        "curves": _curves(results) if results else None,
        "sensitivity": _sensitivity(swept) if swept else None,
    }.items():
        if figure is not None:
            # Without the version of matplotlib in it, the same numbers give the same file.
            save_picture(figure, folder / f"{name}.png")


def panels(count: int) -> tuple[Any, list[Any]]:
    """Returns a figure and so many axes."""
    from matplotlib.figure import Figure

    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(1 + 3.1 * columns, 0.6 + 2.7 * rows), dpi=100, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, list(axes[:count])


def _curves(results: Sequence[Result]) -> Any:
    """Draws a panel a task; the pendulum's begins late, on a logarithmic axis."""
    from matplotlib.ticker import EngFormatter

    figure, axes = panels(len(results))
    for ax, result in zip(axes, results, strict=True):
        curve = result.curve
        steps = curve["env_steps"]
        for low, high, colour, alpha in (("q5", "q95", 4, 0.25), ("low", "high", 0, 0.4)):
            band = {"color": _COLOURS[colour], "alpha": alpha, "linewidth": 0}
            ax.fill_between(steps, curve[low], curve[high], **band)
        ax.plot(steps, curve["iqm"], color=_COLOURS[0], linewidth=1.8)
        if result.task.published is not None:
            ax.axhline(result.task.published[0], color="black", linestyle="--", linewidth=1)
        if result.task.env.startswith("InvertedPendulum"):
            ax.set(xscale="log", xlim=(steps[steps > 0][0], steps[-1]))
        seeds = len(result.seeds["seed"])
        ax.set_title(f"{result.task.name}, {seeds:,} seeds", fontsize="small")
        ax.tick_params(labelsize="x-small")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.grid(alpha=0.3)
    handles = [
        _line(color=_COLOURS[0], label="IQM over seeds, 95 % interval"),
        _line(color=_COLOURS[4], linewidth=6, alpha=0.4, label="5 to 95 % of seeds"),
        _line("black", f"published mean after {PUBLISHED_STEPS:,} env steps", linestyle="--"),
    ]
    _legend(figure, handles, len(axes))
    figure.supxlabel("env steps of a seed", fontsize="small")
    figure.supylabel("return", fontsize="small")
    return figure


def _sensitivity(results: Sequence[Result]) -> Any:
    """Draws a panel a task: a line a setting, over the factor by which it is moved."""
    figure, axes = panels(len(results))
    settings: dict[str, None] = {}
    for result in results:
        settings |= dict.fromkeys(str(x) for x in (result.moved or {})["setting"][1:])
    styles = dict(zip(settings, zip(_COLOURS, _MARKERS, strict=True), strict=False))
    for ax, result in zip(axes, results, strict=True):
        _moved_panel(ax, result, styles)
    handles = [_line(c, setting_in_words(name), marker=m) for name, (c, m) in styles.items()]
    handles.append(_line("black", "defaults, 95 % interval", linewidth=6, alpha=0.2))
    _legend(figure, handles, len(axes))
    figure.supxlabel("factor by which one setting is moved", fontsize="small")
    return figure


def _moved_panel(ax: Any, result: Result, styles: Mapping[str, tuple[str, str]]) -> None:
    moved, (name, value, low, high) = result.moved, moved_measure(result)
    assert moved is not None
    scale = 100 if name == "solved" else 1
    ax.axhspan(scale * low[0], scale * high[0], color="black", alpha=0.15, linewidth=0)
    drawn = [setting for setting in styles if setting in moved["setting"]]
    for place, setting in enumerate(drawn):
        rows = np.flatnonzero((moved["setting"] == setting) | (moved["setting"] == "default"))
        rows = rows[np.argsort(moved["factor"][rows])]
        colour, marker = styles[setting]
        # Beside each other, so that intervals show.
        x = moved["factor"][rows] * 1.05 ** (place - (len(drawn) - 1) / 2)
        errors = np.abs(scale * (np.stack([low[rows], high[rows]]) - value[rows]))
        errors[:, moved["factor"][rows] == 1] = 0
        style = {"color": colour, "marker": marker, "markersize": 4, "linewidth": 1}
        ax.errorbar(x, scale * value[rows], errors, **style)
    ax.set(xscale="log", ylabel="solved (%)" if name == "solved" else "return (IQM)")
    ax.set_xticks([1 / FACTOR, 1, FACTOR], [f"1/{FACTOR}", "1", f"{FACTOR}"])
    ax.minorticks_off()
    ax.set_title(result.task.name, fontsize="small")
    ax.tick_params(labelsize="x-small")
    ax.grid(alpha=0.3)


def _legend(figure: Any, handles: Sequence[Any], panels: int) -> None:
    """Writes a legend above the panels, as wide as they are."""
    columns = 1 + min(panels, _COLUMNS)
    where = {"loc": "outside upper center", "ncols": columns, "frameon": False}
    figure.legend(handles=handles, fontsize="x-small", **where)


def _line(color: str, label: str, **style: Any) -> Any:
    """Returns a line for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=color, label=label, **style)
