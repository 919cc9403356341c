"""The picture of docs/results.md: returns against seconds of training."""

from pathlib import Path

import numpy as np

from experiments.kit.pictures import save_picture
from experiments.studies.results import kept
from experiments.studies.results.tables import PEERS

#: Blue and vermilion for the machines, black and grey for others.
_GPU, _CPU, _PEER = "#0072b2", "#d55e00", "#777777"
_COLUMNS = 4


def draw(folder: Path, docs: Path, path: Path) -> None:
    """Draws a panel a task: our means with intervals, and what others reached.

    Args:
      folder: of the small files.
      docs: of published.csv and peers.csv.
      path: of the picture.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    found, others = kept.curves(folder), kept.peers(docs / "peers.csv")
    tasks = list(dict.fromkeys(group.task for group in kept.clock(folder)))
    rows = -(-len(tasks) // _COLUMNS)
    figure = Figure(figsize=(13.4, 0.6 + 2.7 * rows), dpi=100, layout="constrained")
    for number, task in enumerate(tasks, 1):
        ax = figure.add_subplot(rows, _COLUMNS, number)
        for (name, device), curve in found.items():
            if name == task:
                color = _CPU if "threads" in device else _GPU
                band = (curve["seconds"], curve["low"], curve["high"])
                ax.fill_between(*band, color=color, alpha=0.25)
                ax.plot(curve["seconds"], curve["mean"], color=color)
        for algorithm, style in (("PPO", "--"), ("SAC", ":")):
            if best := kept.published(docs / "published.csv", task, algorithm):
                ax.axhline(best.mean, color="black", linestyle=style, linewidth=1)
        for (name, peer, _), budgets in others.items():
            if name == task and peer in PEERS:
                means = [np.mean(values) for values in budgets.values()]
                marker = "os"[PEERS.index(peer)]
                ax.plot(list(budgets), means, marker, color=_PEER, markersize=5)
        ax.set(title=task, xlabel="seconds of training")
        ax.set_xscale("log", subs=[2, 5])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("{x:g}")
        ax.tick_params(axis="x", which="both", labelsize=8)
    figure.axes[0].set_ylabel("return without noise")
    shown = {
        "one GPU, all seeds together": Line2D([], [], color=_GPU),
        "two threads, one seed": Line2D([], [], color=_CPU),
        "PPO, published": Line2D([], [], color="black", linestyle="--"),
        "SAC, published": Line2D([], [], color="black", linestyle=":"),
        "Stable-Baselines3 PPO": Line2D([], [], color=_PEER, marker="o", linestyle=""),
        "and SAC, two threads": Line2D([], [], color=_PEER, marker="s", linestyle=""),
    }
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=6, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_picture(figure, path)
