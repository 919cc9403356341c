"""The tables of docs/playground.md: returns after minutes of training beside published ones."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from experiments.kit.markdown import fixed, table
from experiments.kit.rows import read
from experiments.speed.benchmark import rows as benchmark_rows
from experiments.studies.playground.runs import TASKS
from experiments.studies.results.tables import compare, estimate, number
from mjx_reinforce.settings.defaults import SUITE
from mjx_reinforce.statistics import Estimate, estimate_mean

#: What every task is trained for, in minutes.
BUDGETS = (1, 8)
RETURNS, AGREEMENT, PUBLISHED = "returns.csv", "agreement.csv", "published.csv"
BREAKS = "breaks.csv"
#: Published means after so many seconds of training.
PUBLISHED_SECONDS = "published_seconds.csv"
#: Rows of ``experiments.speed.benchmark gpu --tasks playground:...``.
SPEEDS = "speeds.csv"
#: Final returns of sweeps over settings, a row for each seed.
SETTINGS = "settings.csv"
_RIVALS = ("Playground, MJX", "Playground, MJX-Warp")


class Result(NamedTuple):
    """A run: its task, its budget of all seeds together (min), and what its rows say.

    returns: [S] of the seeds' policies, each a mean over fresh episodes; 0, the least that the
      suite pays, for a policy of which a test episode broke
    """

    task: str
    minutes: float
    device: str
    returns: np.ndarray
    env_steps: float
    seconds: float


def results(data: Path) -> list[Result]:
    """Returns the runs of the data, by task and budget."""
    path = data / RETURNS
    lines = read(path) if path.exists() else []
    lines.sort(key=lambda row: (TASKS.index(row["task"]), float(row["minutes"])))
    return [
        Result(
            task=task,
            minutes=float(minutes),
            device=task_rows[0]["device"],
            returns=_test_returns(task_rows),
            env_steps=float(np.mean(_numbers(task_rows, "env_steps"))),
            seconds=float(task_rows[0]["seconds"]),
        )
        for (task, minutes), group in itertools.groupby(
            lines, lambda row: (row["task"], row["minutes"])
        )
        for task_rows in [list(group)]
    ]


def _test_returns(lines: Iterable[dict[str, Any]]) -> np.ndarray:
    """Returns the returns of seeds, 0 for one whose test broke."""
    means = _numbers(lines, "return")
    return np.where(np.isnan(means), 0.0, means)


def _numbers(lines: Iterable[dict[str, Any]], column: str) -> np.ndarray:
    return np.array([float(row[column]) for row in lines])


def _published(data: Path) -> dict[str, dict[str, float]]:
    """Returns published mean returns: by column, by task."""
    columns: dict[str, dict[str, float]] = {}
    for row in read(data / PUBLISHED):
        column = f"{row['algorithm']}, {float(row['env_steps']):.0e}".replace("e+0", "e")
        columns.setdefault(column, {})[row["task"]] = float(row["mean"])
    return columns


def returns(data: Path) -> str:
    """Returns the table of all tasks, with last rows of means, by budget."""
    published = _published(data)
    measured = results(data)
    header = ["task", "on", "minutes", "mean (95%)", "worst seed", "seconds", "env steps a seed"]
    lines = [
        [
            result.task,
            result.device.removeprefix("NVIDIA "),
            f"{result.minutes:g}",
            estimate(estimate_mean(result.returns)),
            number(float(result.returns.min())),
            f"{result.seconds:.0f}",
            f"{result.env_steps:.1e}".replace("e+0", "e").replace("e+", "e"),
            *(_cell(column.get(result.task)) for column in published.values()),
        ]
        for result in measured
    ]
    return table([*header, *published], lines + _means(measured, published))


def _means(measured: Sequence[Result], published: dict[str, dict[str, float]]) -> list[list[str]]:
    """Returns the lines of means over the tasks of each of the study's budgets.

    The first is over all of them, and beside it the columns that have all; the other one is over
    those that all columns have, if these are fewer.
    """
    lines = []
    for minutes in BUDGETS:
        all_tasks = [result for result in measured if result.minutes == minutes]
        common = [x for x in all_tasks if all(x.task in column for column in published.values())]
        groups = {f"mean of the tasks ({len(all_tasks)})": all_tasks}
        groups[f"mean of the tasks of all columns ({len(common)})"] = common
        for label, group in groups.items():
            if not group or (group is common and len(common) == len(all_tasks)):
                continue
            mean = fmean(float(result.returns.mean()) for result in group)
            means = [
                fmean(column[result.task] for result in group)
                if all(result.task in column for result in group)
                else None
                for column in published.values()
            ]
            lines.append([label, "", f"{minutes:g}", _cell(mean), "", "", "", *map(_cell, means)])
    return lines


def after_a_minute(data: Path) -> str:
    """Returns the table of returns after a minute beside published ones, the most lost first."""
    published: dict[str, dict[str, float]] = {}
    for row in sorted(read(data / PUBLISHED_SECONDS), key=lambda row: row["algorithm"]):
        label = f"{row['algorithm']}, {float(row['seconds']):.0f} s"
        published.setdefault(label, {})[row["task"]] = float(row["mean"])

    def best(task: str) -> float:
        return max(column[task] for column in published.values() if task in column)

    minute = [result for result in results(data) if result.minutes == 1]
    minute.sort(key=lambda result: result.returns.mean() / best(result.task))
    lines = [
        [
            result.task,
            estimate(estimate_mean(result.returns)),
            *(_cell(column.get(result.task)) for column in published.values()),
        ]
        for result in minute
    ]
    return table(["task", "here, a minute", *published], lines)


def _cell(mean: float | None) -> str:
    return "" if mean is None else fixed(mean, 0)


def speeds(data: Path) -> str:
    """Returns the table of env steps/s beside Playground's own, the least ratio first.

    Each is the best of the numbers of worlds that were tried.
    """
    best: dict[str, dict[str, float]] = {}
    for row in benchmark_rows.read(data / SPEEDS):
        name = row["engine"]
        if name == "native":
            name = "make_vec" if row["what"].startswith("env steps") else "rollout"
        of_task = best.setdefault(row["task"].removeprefix("playground:"), {})
        of_task[name] = max(of_task.get(name, 0.0), benchmark_rows.speed(row))

    def ratio(of_task: dict[str, float], ours: str = "make_vec") -> float:
        return of_task[ours] / max(of_task.get(name, 0.0) for name in _RIVALS)

    lines = []
    for task, of_task in sorted(best.items(), key=lambda item: ratio(item[1])):
        names = ("rollout", "make_vec", *_RIVALS)
        cells = [f"{of_task[name]:.2e}".replace("e+0", "e") for name in names]
        ratios = (ratio(of_task), ratio(of_task, "rollout"))
        lines.append([task, *cells, *(f"{x:.1f}" for x in ratios)])
    header = ["task", "ours, rollout", "ours, `make_vec`", *_RIVALS]
    return table([*header, "`make_vec` / the better", "rollout / the better"], lines)


def settings(data: Path) -> str:
    """Returns the table of sweeps over settings: of each combination the tasks' means and worst."""
    returns_of: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    for row in read(data / SETTINGS):
        num_entries, _ = SUITE[row["task"]]
        std = "1" if float(row["initial_std"]) == 1 else "1 / sqrt(n)"
        kl = f"{float(row['max_kl']) / num_entries:g} n"
        by_task = returns_of.setdefault((kl, std, row["entropy_cost"]), {})
        by_task.setdefault(row["task"], []).append(float(row["final_return"]))
    tasks = list(dict.fromkeys(task for by_task in returns_of.values() for task in by_task))
    lines = [
        [*combination, *(_mean_and_worst(by_task[task]) for task in tasks)]
        for combination, by_task in sorted(returns_of.items())
    ]
    return table(["`--max-kl`", "`--initial-std`", "`--entropy-cost`", *tasks], lines)


def _mean_and_worst(returns: Sequence[float]) -> str:
    return f"{number(fmean(returns))} ({number(min(returns))})"


def agreement(data: Path) -> str:
    """Returns the table of the same policies here and on Playground's own environments."""
    path = data / AGREEMENT
    lines = read(path) if path.exists() else []
    cells: list[Sequence[str]] = []
    for task in TASKS:
        task_rows = [row for row in lines if row["task"] == task]
        ours = _numbers((x for x in task_rows if x["implementation"] == "ours"), "return")
        theirs = _numbers((x for x in task_rows if x["implementation"] != "ours"), "return")
        if not task_rows:
            continue
        means = (number(float(x.mean())) for x in (ours, theirs))
        label = f"{task} (seed {task_rows[0]['seed']})"
        if _are_alike(ours) and _are_alike(theirs):
            # One return tells nothing of others, as where all episodes have the same start.
            difference = Estimate(float(theirs.mean() - ours.mean()), np.nan, np.nan)
        else:
            difference = compare(ours, theirs)
        cells.append([label, str(len(ours)), *means, estimate(difference)])
    return table(["task", "episodes", "here", "Playground", "Playground less here (95%)"], cells)


def _are_alike(returns: np.ndarray) -> bool:
    """Returns whether returns differ by rounding in float32 alone."""
    return bool(np.ptp(returns) <= 1e-6 * np.abs(returns).max())


def breaks(data: Path) -> str:
    """Returns the table of how many episodes broke, by policy and model."""
    path = data / BREAKS
    counts: dict[tuple[str, str], dict[str, str]] = {}
    rows = read(path) if path.exists() else []
    models = list(dict.fromkeys(row["model"] for row in rows))
    rows.sort(key=lambda row: (row["task"], row["seed"], models.index(row["model"])))
    for row in rows:
        cells = counts.setdefault((f"{row['task']} (seed {row['seed']})", row["model"]), {})
        cells[row["implementation"]] = f"{row['broken']} of {row['episodes']}"
    names = {"native": "machine code", "mujoco": "C MuJoCo", "MJX": "Playground, MJX"}
    lines = [[*key, *(cells.get(name, "") for name in names)] for key, cells in counts.items()]
    return table(["policy", "model", *names.values()], lines)
