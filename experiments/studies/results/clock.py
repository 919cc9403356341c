"""The first part of docs/results.md: returns by seconds, on a GPU and on two cores."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.kit.markdown import listed, table
from experiments.kit.pictures import save_picture
from experiments.studies.results import seconds as kept
from experiments.studies.results.figures import panels
from experiments.studies.results.tables import estimate, number, play_table, seconds
from mjx_reinforce.reports.statistics.aggregates import interval

#: Commit -> what its settings were that have changed since.
_SINCE = {
    "e6f8e08c5022": "since then Swimmer has shorter steps",
    "08b5cddba03e": (
        "HalfCheetah had its cut of 250 env steps, which is the default since then, from\n"
        "`--train-horizon 250 --eval-every 20` (on two threads `--eval-every 240`; on a GPU the\n"
        "default is 120 by now)"
    ),
}
_PEERS = ("Stable-Baselines3 PPO", "Stable-Baselines3 SAC")
#: Blue and vermilion for the machines, black and grey for others.
_COLOURS = {"GPU": "#0072b2", "CPU": "#d55e00"}


def sections(results: Path, docs: Path) -> list[str]:
    """Returns the sections of the page, none where no run was given a time.

    Args:
      results: the folder of the small files.
      docs: that of published.csv and peers.csv, and of the picture.
    """
    groups = kept.load(results)
    if not groups:
        return []
    gpu, cpu = ([x for x in groups if is_gpu(x.device) == wanted] for wanted in (True, False))
    parts = ["## Against the clock", _words(groups)]
    if gpu:
        cards = " or ".join(dict.fromkeys(x.device for x in gpu))
        parts += [f"### On one {cards}", _gpu(gpu, docs)]
    if cpu:
        parts += ["### On two threads of a processor", _cpu_words(), _cpu(cpu, docs)]
    _draw(groups, results, docs)
    parts.append("![Return against seconds of training](results/seconds.png)")
    if rows := [row for row in kept.noise(results) if is_gpu(row["device"])]:
        parts += ["### How many episodes an update needs", _noise_words(), _noise(rows)]
    if played := kept.played(results):
        films = {task: Path("films") / task for task in played}
        words = (
            "The best and the median seed of these runs by their last evaluation, without noise,\n"
            "here and in plain Gymnasium, from starts that were used nowhere else:"
        )
        parts += ["### In Gymnasium, and films", words, play_table(played, films, docs)]
    return parts


def is_gpu(device: str) -> bool:
    """Returns whether a device, in words, is a GPU."""
    return "threads" not in device


def _words(groups: Sequence[kept.Group]) -> str:
    rows = [row for group in groups for row in group.rows]
    roots, commits = (
        listed(dict.fromkeys(row[name] for row in rows)) for name in ("root", "commit")
    )
    changed = "".join(f"; {words}" for commit, words in _SINCE.items() if commit in commits)
    return (
        "The settings are those that a budget of that size selected (`settings/tuned.toml`), at\n"
        f"commit {commits}{changed}.\n"
        "On a GPU that is `python -m mjx_reinforce.train --env TASK --num-seeds 16 --seed ROOT\n"
        "--env-steps N` with the seeds and env steps of the table.\n"
        "Time is that of training with its evaluations, of all seeds together; compiling is\n"
        "apart. After a minute: the last evaluation until then. At the end, and of a run that\n"
        "ended within the minute: episodes from starts that were used nowhere else; where a run\n"
        "was stopped, its last evaluation. There is no\n"
        "bootstrapped value, no importance weight, no replayed step: an update is one gradient\n"
        "of the episodes just played. What is subtracted from a return is the mean of the other\n"
        "episodes, for Ant and Humanoid a learned value. No search used these seeds\n"
        f"(roots {roots}).\n"
        "Published figures are the best of each algorithm in [published.csv](published.csv),\n"
        "whatever the version of the task, with the env steps of a seed."
    )


def _gpu(groups: Sequence[kept.Group], docs: Path) -> str:
    rows = []
    for group in groups:
        final = interval("mean", group.final)
        rows.append(
            [
                group.task,
                group.device.removeprefix("NVIDIA ").split()[0],
                str(len(group.final)),
                f"{number(group.minute.mean())}, {number(group.minute.min())}",
                estimate(final),
                number(group.final.min()),
                number(group.final.max()),
                seconds(group.seconds) + _stopped(group),
                f"{group.env_steps:.2g}".replace("e+0", "e").replace("e+", "e"),
                _published(docs, group.task, "PPO"),
                _published(docs, group.task, "SAC"),
            ]
        )
    header = ["task", "on", "seeds", "after a minute: mean, worst", "at the end: mean (95 %)"]
    header += ["worst", "best seed", "seconds, all seeds", "env steps a seed", "PPO, published"]
    return table([*header, "SAC, published"], rows)


def _published(docs: Path, task: str, algorithm: str) -> str:
    figure = kept.published(docs / "published.csv", task, algorithm)
    if figure is None:
        return "none"
    return f"{number(figure.mean)} ({figure.source}, {figure.env_steps / 1e6:.2g} million)"


def _cpu_words() -> str:
    return (
        "The default command with `--num-seeds 1`, a run for each root; evaluations on the\n"
        "way have the same starts in all of them. Beside it, where it ran\n"
        "on two threads of the same processor, Stable-Baselines3 on Gymnasium's tasks, after a\n"
        "minute and after ten: one seed (the minute: two runs), with the settings of its zoo\n"
        "([peers.csv](peers.csv))."
    )


def _cpu(groups: Sequence[kept.Group], docs: Path) -> str:
    others = kept.peers(docs / "peers.csv")
    rows = []
    for group in groups:
        rows.append(
            [
                group.task,
                group.device,
                str(len(group.final)),
                _spread(group.minute),
                f"{_spread(group.final)} after {seconds(group.seconds)}{_stopped(group)}",
                *(_peer(others.get((group.task, peer, _threads(group.device)))) for peer in _PEERS),
            ]
        )
    header = ["task", "on", "runs", "after a minute: median (worst, best)", "at the end"]
    return table([*header, "PPO: 1, 10 minutes", "SAC: 1, 10 minutes"], rows)


def _noise_words() -> str:
    return (
        "The noise scale of the gradient, in episodes ([statistics.md](statistics.md)): with so\n"
        "many an update has as much noise as signal. By quarters of the updates of the runs\n"
        "above, the median over evaluations and seeds. Not seen: the noise hid the signal."
    )


def _noise(rows: Sequence[dict[str, str]]) -> str:
    parts: dict[tuple[str, str], list[list[float]]] = {}
    for row in rows:
        empty: list[list[float]] = [[] for _ in range(kept.PARTS)]
        found = parts.setdefault((row["task"], row["episodes"]), empty)
        found[int(row["part"])].append(float(row["snr"]))
    lines = []
    for (task, episodes), found in parts.items():
        scales = [float(episodes) / max(float(np.median(x)), 1e-9) for x in found]
        lines.append([task, episodes, *(f"{x:,.0f}" if x < 1e6 else "not seen" for x in scales)])
    header = ["task", "episodes an update", *(f"quarter {i + 1}" for i in range(kept.PARTS))]
    return table(header, lines)


def _stopped(group: kept.Group) -> str:
    return " (stopped)" if group.stopped else ""


def _threads(words: str) -> str:
    """Returns "2 of 32 threads" of a machine in words."""
    return words.rpartition(", ")[2]


def _spread(values: np.ndarray) -> str:
    low, middle, high = (number(float(f(values))) for f in (np.min, np.median, np.max))
    return f"{middle} ({low}, {high})"


def _peer(budgets: dict[float, list[float]] | None) -> str:
    if budgets is None:
        return "not run"
    found = (budgets.get(seconds) for seconds in (60.0, 600.0))
    return ", ".join(number(float(np.mean(x))) if x else "not run" for x in found)


def _draw(groups: Sequence[kept.Group], results: Path, docs: Path) -> None:
    """Draws a panel a task: our means with intervals, and what others reached."""
    found = kept.curves(results)
    others = kept.peers(docs / "peers.csv")
    tasks = list(dict.fromkeys(group.task for group in groups))
    figure, axes = panels(len(tasks))
    for ax, task in zip(axes, tasks, strict=True):
        for (name, device), curve in found.items():
            if name != task:
                continue
            colour = _COLOURS["GPU" if is_gpu(device) else "CPU"]
            ax.fill_between(curve["seconds"], curve["low"], curve["high"], color=colour, alpha=0.25)
            ax.plot(curve["seconds"], curve["mean"], color=colour)
        for algorithm, style in (("PPO", "--"), ("SAC", ":")):
            if best := kept.published(docs / "published.csv", task, algorithm):
                ax.axhline(best.mean, color="black", linestyle=style, linewidth=1)
        for peer, marker in zip(_PEERS, ("o", "s"), strict=True):
            for (name, other, _), budgets in others.items():
                if (name, other) == (task, peer):
                    means = [np.mean(values) for values in budgets.values()]
                    ax.plot(list(budgets), means, marker, color="#777777", markersize=5)
        ax.set(title=task, xscale="log", xlabel="seconds of training")
    axes[0].set_ylabel("return without noise")
    figure.legend(*_legend(), loc="outside lower center", ncols=6, frameon=False)
    (docs / "results").mkdir(parents=True, exist_ok=True)
    save_picture(figure, docs / "results" / "seconds.png")


def _legend() -> tuple[list, list[str]]:
    from matplotlib.lines import Line2D

    shown = {
        "one GPU, all seeds together": Line2D([], [], color=_COLOURS["GPU"]),
        "two threads, one seed": Line2D([], [], color=_COLOURS["CPU"]),
        "PPO, published": Line2D([], [], color="black", linestyle="--"),
        "SAC, published": Line2D([], [], color="black", linestyle=":"),
        "Stable-Baselines3 PPO": Line2D([], [], color="#777777", marker="o", linestyle=""),
        "and SAC, two threads": Line2D([], [], color="#777777", marker="s", linestyle=""),
    }
    return list(shown.values()), list(shown)
