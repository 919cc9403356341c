"""One figure a document: our seeds, ours without the mistake, and the program's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.reproduce.cases import Case
from experiments.studies.reproduce.mistakes import STALE
from experiments.studies.reproduce.statistics import spread, windowed
from mjx_reinforce.settings.presets import PRESETS


def draw(
    path: Path,
    panels: Sequence[tuple[Case, np.ndarray, np.ndarray | None, np.ndarray | None]],
    reference: Mapping[str, Any],
) -> None:
    """Draws our seeds, ours without the mistake, and the program's, a panel for each case."""
    from matplotlib.figure import Figure

    size = (1 + 5 * max(len(panels), 1.4), 4)
    figure = Figure(figsize=size, dpi=90, layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw_panel(axes, *panel, reference)
    save_picture(figure, path)


def _draw_panel(
    axes: Any,
    case: Case,
    scores: np.ndarray,
    repaired: np.ndarray | None,
    stale: np.ndarray | None,
    reference: Mapping[str, Any],
) -> None:
    episodes = PRESETS[case.preset][1].episodes_per_update
    window = reference[case.references[0]]["window_updates"]
    curves = [(scores, "tab:blue", f"ours, {scores.shape[1]} seeds, 95 % of them")]
    if repaired is not None and case.repair is not None:
        curves.append((repaired, "tab:orange", f"ours, {case.repair[0]}"))
    if stale is not None:
        curves.append((stale, "tab:green", f"ours, {STALE}"))
    for values, colour, label in curves:
        step = max(1, min(window, len(values)) // 5 if len(values) <= 500 else window)
        counts = range(step, len(values) + 1, step)
        smooth = np.stack([windowed(values, count, window) for count in counts])
        x = np.array(counts) * episodes
        axes.plot(x, smooth.mean(axis=1), color=colour, linewidth=2, label=label)
        axes.fill_between(x, *spread(smooth), color=colour, alpha=0.2, linewidth=0)
    last = len(scores) * episodes
    for name, colour in zip(case.references, ("black", "tab:red"), strict=False):
        _draw_program(axes, reference[name], episodes, last, colour, f"the program's ({name})")
    axes.set(xlabel="episodes", ylabel="return", title=case.title, xlim=(0, last))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="x-small", frameon=False)


def _draw_program(
    axes: Any, entry: Mapping[str, Any], episodes: int, last: int, colour: str, label: str
) -> None:
    for index, curve in enumerate(entry["seeds"].values()):
        x = (1 + np.arange(len(curve))) * entry["every_updates"] * episodes
        shown = x <= last
        y = np.array(curve)[shown]
        text = label if index == 0 else None
        axes.plot(x[shown], y, color=colour, linewidth=0.8, alpha=0.8, label=text)
