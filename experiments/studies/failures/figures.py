"""The pictures of docs/failures.md."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.failures.answers import Arm, Quarter
from experiments.studies.failures.measures import Kept

#: Colours that differ for colour-blind readers too (Okabe and Ito 2008).
_FAILING, _OTHERS = "#d55e00", "#0072b2"
_TITLES = {
    "scale_position": "std of the cart's position (m)",
    "clipped_position": "steps with clipped position",
    "saturated_units": "saturated hidden units",
    "force_out_of_range": "mean force out of range",
    "kl": "KL of an update (nats)",
    "policy_std": "std of the actions",
}


def draw_all(
    kept: Kept, quarters: Sequence[Quarter], arms: Sequence[Arm], words: dict[str, str], docs: Path
) -> None:
    """Draws failures-*.png.

    Args:
      kept: what was measured.
      quarters: the quarters of the seeds by their position scale.
      arms: what each change did.
      words: the arms' names.
      docs: the folder.
    """
    for name, figure in {
        "curves": _curves(kept),
        "differences": _differences(kept),
        "scale": _scale(quarters),
        "mended": _arms(arms, words),
    }.items():
        # Without the version of matplotlib in it, the same numbers give the same file.
        save_picture(figure, docs / f"failures-{name}.png")


def _figure(rows: int, columns: int, width: float, height: float, **shared: Any) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=90, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **shared)


def _curves(kept: Kept) -> Any:
    """Draws the failing seeds, those that never solved the task beside those that fell again."""
    figure, axes = _figure(1, 2, 8.5, 2.9, sharey=True)
    seeds = dict.fromkeys(row["seed"] for row in kept.curves)
    steps_to_solve = kept.seeds["base"]["steps_to_solve"]
    for ax, never in zip(axes[0], (True, False), strict=True):
        chosen = [s for s in seeds if np.isnan(steps_to_solve[int(s)]) == never]
        for number, seed in enumerate(chosen):
            rows = [row for row in kept.curves if row["seed"] == seed]
            x = [float(row["env_steps"]) / 1000 for row in rows]
            colour = _COLOURS[number % len(_COLOURS)]
            ax.plot(x, [float(row["return"]) for row in rows], color=colour, linewidth=1)
        title = "never solved" if never else "solved, and fallen at the end"
        ax.axhline(950, color="grey", linewidth=0.8, linestyle=":")
        ax.set(title=f"{title}: {len(chosen)} seeds", xlabel="thousand env steps")
    axes[0, 0].set_ylabel("return without noise")
    return figure


_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")


def _differences(kept: Kept) -> Any:
    """Draws quartiles of failing and of other seeds over the first updates."""
    figure, axes = _figure(2, 3, 9, 4.6, sharex=True)
    for ax, (measure, title) in zip(axes.flat, _TITLES.items(), strict=True):
        for group, colour in (("failing", _FAILING), ("other", _OTHERS)):
            rows = [r for r in kept.updates if r["measure"] == measure and r["group"] == group]
            x = [int(row["update"]) for row in rows]
            low, middle, high = (
                [float(row[name]) for row in rows] for name in ("low", "median", "high")
            )
            ax.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
            ax.plot(x, middle, color=colour, label=f"{group} seeds")
        ax.set_title(title, fontsize="medium")
        ax.set_ylim(bottom=0 if measure != "policy_std" else None)
    axes[0, 0].legend(fontsize="small", frameon=False)
    for ax in axes[1]:
        ax.set_xlabel("update")
    return figure


def _scale(quarters: Sequence[Quarter]) -> Any:
    """Draws shares of failing seeds and of fallen evaluations over the scale."""
    figure, axes = _figure(1, 2, 8.5, 2.8)
    names = [f"{q.low * 100:.1f} to {q.high * 100:.1f}" for q in quarters]
    for ax, title, values in (
        (axes[0, 0], "failing seeds", [q.failing for q in quarters]),
        (axes[0, 1], "seeds that fell again at least once", [q.fallen for q in quarters]),
    ):
        _bars(ax, values, names)
        ax.set(title=title, xlabel="std of the cart's position where it froze (cm)", ylabel="%")
    return figure


def _bars(ax: Any, values: Sequence[Any], names: Sequence[str]) -> None:
    middle = 100 * np.array([x.value for x in values])
    low, high = (100 * np.array([getattr(x, end) for x in values]) for end in ("low", "high"))
    ax.bar(range(len(names)), middle, color=_OTHERS, width=0.6, alpha=0.6)
    ax.errorbar(range(len(names)), middle, [middle - low, high - middle], fmt="none", color="black")
    ax.set_xticks(range(len(names)), names)


def _arms(arms: Sequence[Arm], words: dict[str, str]) -> Any:
    """Draws what each change did, with 95 % intervals."""
    figure, axes = _figure(1, 2, 9, 1.2 + 0.27 * len(arms), sharey=True)
    y = -np.arange(len(arms))
    for ax, title, name in (
        (axes[0, 0], "failing seeds, %", "failing"),
        (axes[0, 1], "fell again at least once, %", "fallen"),
    ):
        found = [getattr(arm, name) for arm in arms]
        ax.axvspan(100 * found[0].low, 100 * found[0].high, color="grey", alpha=0.15, linewidth=0)
        for place, x in zip(y, found, strict=True):
            ax.plot([100 * x.low, 100 * x.high], [place, place], color=_OTHERS, linewidth=2)
            ax.plot(100 * x.value, place, "o", color=_OTHERS, markersize=5)
        ax.set(title=title)
        ax.set_xlim(left=0)
        ax.grid(axis="x", alpha=0.3)
    axes[0, 0].set_yticks(y, [words[arm.name] for arm in arms])
    return figure
