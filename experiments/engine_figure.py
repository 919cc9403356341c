"""Draws docs/engine.png: env steps a second against the size of the task, engine by engine.

``python experiments/engine_figure.py`` reads docs/engine.csv: for each task, device and engine the
scalar operations of a step, and env steps a second; docs/benchmarks.md says of which day.
"""

import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

DOCS = Path(__file__).parents[1] / "docs"
#: engine -> colour (Okabe and Ito's, for all eyes) and marker
STYLES = {
    "native": ("#0072B2", "o"),
    "before native": ("#E69F00", "s"),
    "plain MJX": ("#999999", "v"),
    "MuJoCo Warp": ("#009E73", "^"),
    "C MuJoCo": ("#D55E00", "D"),
}
#: Task -> where its name stands, in points from its own, and the side that is there.
PLACES = {
    "InvertedDoublePendulum": ((-6, -3), "right"),
    "Hopper": ((-7, 1), "right"),
    "HalfCheetah": ((0, 10), "center"),
    "Walker2d": ((-7, -4), "right"),
    "Pusher": ((7, -6), "left"),
    "HumanoidStandup": ((7, -9), "left"),
}


def main() -> None:
    """Reads and draws."""
    with (DOCS / "engine.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    devices = list(dict.fromkeys(row["device"] for row in rows))
    figure = Figure(figsize=(5.5 * len(devices), 4.8), dpi=150, layout="constrained")
    for axes, device in zip(figure.subplots(1, len(devices), sharex=True), devices, strict=True):
        lines = defaultdict(list)
        for row in rows:
            if row["device"] == device:
                point = float(row["operations"]), float(row["env_steps_per_second"])
                lines[row["engine"]].append(point)
                if row["engine"] == "native":
                    name = row["task"].removesuffix("-v5")
                    place, side = PLACES.get(name, ((7, 4), "left"))
                    axes.annotate(name, point, place, textcoords="offset points", size=7, ha=side)
        for engine, points in lines.items():
            colour, marker = STYLES[engine]
            x, y = zip(*points, strict=True)
            axes.loglog(x, y, marker, color=colour, label=engine)
        axes.set(title=device, xlabel="scalar operations of a step, a loop's body once")
        axes.set_ylabel("env steps a second")
        axes.margins(x=0.4, y=0.12)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.savefig(DOCS / "engine.png")


if __name__ == "__main__":
    main()
