"""The picture of docs/results.md: returns against seconds of training."""

from pathlib import Path

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.results import kept
from experiments.studies.results.tables import PEERS

#: A word of the device -> vermilion for CPUs, two blues for GPUs; the first that fits counts.
_COLORS = {"threads": "#d55e00", "H200": "#56b4e9", "": "#0072b2"}
_PEER = "#777777"
#: The line of runs that are each the best of several.
_RACES = "-."


def draw(folder: Path, docs: Path, path: Path) -> None:
    """Draws a panel a task: our means with intervals, and what others reached.

    Args:
      folder: of the small files.
      docs: of published.csv and peers.csv.
      path: of the picture.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    curves = kept.curves(folder)
    peers = kept.peers(docs / "peers.csv")
    tasks = list(dict.fromkeys(kept.env_id(group.task) for group in kept.clock(folder)))
    rows = -(-len(tasks) // 4)
    figure = Figure(figsize=(13, 0.6 + 2.6 * rows), dpi=100, layout="constrained")
    for number, task in enumerate(tasks, 1):
        ax = figure.add_subplot(rows, 4, number)
        for (name, device), curve in curves.items():
            if kept.env_id(name) == task:
                color = next(color for word, color in _COLORS.items() if word in device)
                band = (curve["seconds"], curve["low"], curve["high"])
                style = "-" if name == task else _RACES
                ax.fill_between(*band, color=color, alpha=0.25)
                ax.plot(curve["seconds"], curve["mean"], style, color=color)
        for algorithm, style in (("PPO", "--"), ("SAC", ":")):
            if best := kept.published(docs / "published.csv", task, algorithm):
                ax.axhline(best.mean, color="black", linestyle=style, linewidth=1)
        for (name, peer, _), budgets in peers.items():
            if name == task and peer in PEERS:
                means = [np.mean(values) for values in budgets.values()]
                ax.plot(list(budgets), means, "os"[PEERS.index(peer)], color=_PEER, markersize=5)
        ax.set(title=task, xlabel="seconds of training")
        ax.set_xscale("log", subs=[2, 5])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("{x:g}")
        ax.tick_params(axis="x", which="both", labelsize=8)
    figure.axes[0].set_ylabel("return without noise")
    shown = {
        "one H100": Line2D([], [], color=_COLORS[""]),
        "one H200": Line2D([], [], color=_COLORS["H200"]),
        "best of races": Line2D([], [], color=_COLORS["H200"], linestyle=_RACES),
        "two CPU threads": Line2D([], [], color=_COLORS["threads"]),
        "PPO, published": Line2D([], [], color="black", linestyle="--"),
        "SAC, published": Line2D([], [], color="black", linestyle=":"),
        "Stable-Baselines3 PPO": Line2D([], [], color=_PEER, marker="o", linestyle=""),
        "its SAC": Line2D([], [], color=_PEER, marker="s", linestyle=""),
    }
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_picture(figure, path)
