"""The pictures of the seeds study."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.seeds.answers import (
    CONTRASTS,
    DEFAULTS,
    MEASURES,
    Effect,
    best_rates,
    select,
)
from experiments.studies.seeds.few import AnyPair, FewSeeds
from experiments.studies.seeds.runs import Task

#: Colours that differ for colour-blind readers too (Okabe and Ito 2008), and shapes.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
_MARKERS = ("o", "s", "^", "D", "v", "P")
_ESTIMATORS = {
    "reward-to-go": "no baseline",
    "leave-one-out": "the other episodes' mean",
    "value-baseline": "a learned baseline",
}
_UNITS = {
    "final return": "final return (IQM),\n% of the way to solved",
    "solved at the end": "solved at the end,\npercentage points",
    "average return": "average return,\n% of the way to solved",
    "env steps to solve": "env steps saved,\n% of the budget",
}


def scale(task: Task, measure: str) -> float:
    """Returns what turns a measure into percent, positive where the first arm is better."""
    if measure == "solved at the end":
        return 100.0
    if measure == "env steps to solve":
        return -100.0 / task.budget
    return 100.0 / (task.threshold - task.untrained)


def draw_all(
    tasks: Sequence[Task],
    effects: Sequence[Effect],
    few: Sequence[FewSeeds],
    pairs: Sequence[AnyPair],
    folder: Path,
) -> None:
    """Draws all pictures of the page into a folder."""
    by_name = {task.name: task for task in tasks}
    for name, figure in {
        "curves": _curves(tasks),
        "effects": _effects(by_name, effects),
        "rates": _rates(by_name, effects),
        "wrong_winner": _wrong_winner(few, pairs),
    }.items():
        # Without the version of matplotlib in it, the same numbers give the same file.
        save_picture(figure, folder / f"{name}.png")


def _figure(rows: int, columns: int, width: float, height: float, **shared: Any) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **shared)


def _curves(tasks: Sequence[Task]) -> Any:
    """Draws the learning curves of the three baselines, each at its best learning rate."""
    figure, axes = _figure(1, len(tasks), 1 + 3.6 * len(tasks), 3.4)
    for ax, task in zip(axes[0], tasks, strict=True):
        rates = _best_of_each(task)
        for colour, (estimator, name) in zip(_COLOURS, _ESTIMATORS.items(), strict=False):
            settings = DEFAULTS | {"estimator": estimator, "learning_rate": rates[estimator]}
            curve = select(task, task.curves, settings)
            label = f"{name} ({rates[estimator]:g})"
            ax.plot(task.grid / 1000, curve, color=colour, linewidth=2, label=label)
        ax.axhline(task.threshold, color="grey", linewidth=0.8, linestyle=":")
        ax.set(title=task.name, xlabel="thousand env steps")
        ax.legend(fontsize="x-small", frameon=False)
    axes[0, 0].set_ylabel("return (IQM over all seeds)")
    return figure


def _best_of_each(task: Task) -> dict[str, float]:
    """Returns the learning rate of each estimator that is best on all seeds."""
    rates: dict[str, float] = {}
    for contrast in CONTRASTS:
        if contrast.factor == "estimator":
            rates |= dict(
                zip(contrast.levels, best_rates(task, contrast, slice(None)), strict=True)
            )
    return rates


def _effects(tasks: Mapping[str, Task], effects: Sequence[Effect]) -> Any:
    """Draws every difference with its interval: a row a comparison, a column a measure."""
    figure, axes = _figure(1, len(MEASURES), 12, 1.2 + 1.1 * len(CONTRASTS), sharey=True)
    names = [contrast.name for contrast in CONTRASTS]
    for ax, measure in zip(axes[0], MEASURES, strict=True):
        for effect in effects:
            if effect.measure != measure or effect.where not in ("best", "all"):
                continue
            number, best = list(tasks).index(effect.task), effect.where == "best"
            place = names.index(effect.contrast) + _spread(2 * number + (not best), 2 * len(tasks))
            factor, colour = scale(tasks[effect.task], measure), _COLOURS[number]
            value, low, high, _ = (x * factor for x in effect.difference)
            ax.plot([low, high], [place, place], color=colour, linewidth=1.5)
            filling = colour if best else "white"
            ax.plot(
                value, place, _MARKERS[number], color=colour, markersize=5, markerfacecolor=filling
            )
        ax.axvline(0, color="grey", linewidth=0.8)
        ax.set_xlabel(_UNITS[measure], fontsize="small")
        for line in range(1, len(names)):
            ax.axhline(line - 0.5, color="lightgrey", linewidth=0.5)
    axes[0, 0].set_yticks(
        range(len(names)), [c.name.replace(" against", "\nagainst") for c in CONTRASTS]
    )
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    _legend_of_effects(figure, list(tasks))
    return figure


def _spread(number: int, count: int) -> float:
    """Returns the place of one of several points beside each other, around 0."""
    return 0.7 * ((number + 0.5) / count - 0.5)


def _legend_of_effects(figure: Any, names: Sequence[str]) -> None:
    lines = [_line(c, m, n) for c, m, n in zip(_COLOURS, _MARKERS, names, strict=False)]
    lines.append(_line("black", "o", "each at its best rate", linestyle=""))
    hollow = {"linestyle": "", "markerfacecolor": "white"}
    lines.append(_line("black", "o", "over all other settings", **hollow))
    figure.legend(handles=lines, loc="outside upper center", ncols=len(lines), frameon=False)


def _rates(tasks: Mapping[str, Task], effects: Sequence[Effect]) -> Any:
    """Draws how the difference in average return depends on the learning rate."""
    figure, axes = _figure(1, len(CONTRASTS), 13, 3.2, sharey=True)
    for ax, contrast in zip(axes[0], CONTRASTS, strict=True):
        rates = next(iter(tasks.values())).factors["learning_rate"]
        for (name, task), colour, marker in zip(tasks.items(), _COLOURS, _MARKERS, strict=False):
            found = [
                effect
                for effect in effects
                if (effect.task, effect.contrast) == (name, contrast.name)
                and effect.where not in ("best", "all")
            ]
            values = np.array([effect.difference[:3] for effect in found]).T
            value, low, high = values * scale(task, "average return")
            ax.fill_between(rates, low, high, color=colour, alpha=0.25, linewidth=0)
            ax.plot(rates, value, color=colour, marker=marker, markersize=4, label=name)
        ax.axhline(0, color="grey", linewidth=0.8)
        ax.set(xscale="log", xlabel="learning rate (both arms)")
        ax.set_xticks(rates, [f"{rate:g}" for rate in rates])
        ax.minorticks_off()
        ax.set_title(contrast.name.replace(" against", "\nagainst"), fontsize="small")
    axes[0, 0].set_ylabel("difference in average return,\n% of the way to solved")
    axes[0, 0].legend(fontsize="x-small", frameon=False)
    return figure


def _wrong_winner(few: Sequence[FewSeeds], pairs: Sequence[AnyPair]) -> Any:
    """Draws how often so many seeds name the wrong winner, a panel for each task."""
    figure, axes = _figure(1, len(pairs), 1 + 3.8 * len(pairs), 4.4, sharey=True)
    for ax, pair in zip(axes[0], pairs, strict=True):
        ours = [x for x in few if (x.task, x.measure) == (pair.task, pair.measure)]
        for i, (colour, marker, found) in enumerate(zip(_COLOURS, _MARKERS, ours, strict=False)):
            thicker = len(ours) - i  # so that a line shows behind one that coincides with it
            ax.plot(
                list(found.wrong),
                [100 * x for x in found.wrong.values()],
                color=colour,
                marker=marker,
                markersize=2.5 + 0.9 * thicker,
                linewidth=0.6 + 0.6 * thicker,
                linestyle="-" if found.sure else ":",
            )
        percent = [100 * x for x in pair.wrong.values()]
        ax.plot(list(pair.wrong), percent, color="grey", linewidth=3, alpha=0.6)
        ax.set(xscale="log", xlabel="seeds of each", title=pair.task, ylim=(-1, 65))
        ticks = (2, 3, 5, 10, 20, 50, 100)
        ax.set_xticks(ticks, map(str, ticks))
        ax.minorticks_off()
    axes[0, 0].set_ylabel("names the wrong winner (%)")
    names = [contrast.name for contrast in CONTRASTS]
    lines = [_line(c, m, n) for c, m, n in zip(_COLOURS, _MARKERS, names, strict=False)]
    lines.append(_line("grey", "", "any two settings of the sweep", linewidth=3))
    figure.legend(handles=lines, loc="outside upper center", ncols=2, frameon=False)
    return figure


def _line(colour: str, marker: str, label: str, **style: Any) -> Any:
    """Returns a line for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, marker=marker, label=label, **style)
