"""The small files in data: what is kept of runs, and what docs/results.md is made of.

``of_tasks`` are the runs that ``train`` made: TASK.json has a run's settings, machine and times,
TASK-seeds.csv a row for each seed. ``clock`` are runs that were given a time: seconds.csv has a row
for each seed, seconds-curves.csv the mean over the seeds of a task on a machine, at times on a
logarithmic grid, seconds-play-TASK.csv the episodes that ``play`` played of them. kl_limit.csv are
the curves of the report that docs/scale.md shows.
"""

import itertools
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.kit.rows import read
from experiments.studies.results.runs import ended
from experiments.studies.results.tasks import Task
from mjx_reinforce.files import csv_text, read_json, write_bytes, write_json
from mjx_reinforce.reports.sources import PROVENANCE, read_columns, read_metrics
from mjx_reinforce.statistics import estimate_mean, steps_to_solve

#: The policies that are played, by rank in the final evaluation.
POLICIES = ("best", "median")
#: A budget of everybody (s).
MINUTE = 60.0
_POINTS = 40
_SEEDS, _CURVES, _PLAYED = "seconds.csv", "seconds-curves.csv", "seconds-play-"
_OPTIMUM = "optimum.csv"
_RACING = "racing.csv"
_COLUMNS = ("task", "device", "root", "seed", "status", "commit", "minute", "final", "best")
_COLUMNS += ("seconds", "env_steps", "compile_seconds")
_CURVE = ("seconds", "mean", "low", "high")
_EPISODE = {"policy": str, "seed": int, "simulation": str, "episode": int, "return": float}
_SEED: tuple[str, ...] = (
    "seed",
    "env_steps",
    "test_return",
    "final_return",
    "best_return",
    "env_steps_to_solve",
)

Columns = dict[str, np.ndarray]


class Result(NamedTuple):
    """What is kept of a task.

    facts: of its run: settings, machine, times
    seeds: by column, [S] of each seed; ``env_steps_to_solve`` is inf where it never was;
      ``test_return`` is the last policy's on starts that nothing else used
    """

    task: Task
    facts: dict[str, Any]
    seeds: Columns


class Group(NamedTuple):
    """The runs of one task on one machine that were given a time.

    task, device: which; the device in words
    minute: each seed's return [S] at its last evaluation within ``MINUTE``; of a run that ended
      within it, on fresh starts
    final: each seed's return [S] at the end, on fresh starts; of a run that was stopped, at its
      last evaluation
    seconds: training time of all seeds together, evaluations included; the median of several runs
    env_steps: a seed's, the mean
    stopped: whether a run was stopped before its end
    """

    task: str
    device: str
    minute: np.ndarray
    final: np.ndarray
    seconds: float
    env_steps: float
    stopped: bool

    @property
    def is_gpu(self) -> bool:
        """Whether the device is a GPU."""
        return "threads" not in self.device


def gather_tasks(tasks: Iterable[Task], directory: Path, folder: Path) -> None:
    """Writes the small files of those tasks whose runs in a directory have ended."""
    for task in tasks:
        run = directory / task.name
        if not ended(run):
            continue
        config, summary = read_json(run / "config.json"), read_json(run / "summary.json")
        found = read_metrics(run / "metrics.csv")
        returns, steps = found["eval_return"], found["env_steps"]
        solved = steps_to_solve(returns, steps, summary["threshold"])
        solved = [math.inf if x is None else x for x in solved]
        test, best = summary["final_test_returns"], np.fmax.reduce(returns)
        seeds = zip(range(len(test)), steps[-1], test, returns[-1], best, solved, strict=True)
        rows = [[f"{x:.9g}" for x in row] for row in seeds]
        write_bytes(folder / f"{task.name}-seeds.csv", csv_text([_SEED, *rows]).encode())
        names = ("status", "threshold", "engine", "num_seeds", "compile_seconds", "run_seconds")
        facts = {k: summary[k] for k in names} | {k: config[k] for k in PROVENANCE if k in config}
        facts["settings"] = {k: v for k, v in config.items() if k not in (*PROVENANCE, "output")}
        write_json(folder / f"{task.name}.json", facts)


def of_tasks(tasks: Iterable[Task], folder: Path) -> list[Result]:
    """Returns what is kept of those tasks of which something is."""
    kinds = dict.fromkeys(_SEED, np.float64)
    return [
        Result(task, read_json(path), read_columns(folder / f"{task.name}-seeds.csv", kinds))
        for task in tasks
        if (path := folder / f"{task.name}.json").exists()
    ]


def gather_clock(directory: Path, folder: Path) -> list[str]:
    """Adds the runs of a directory to the small files; returns what was added, in words.

    Args:
      directory: of runs; what is no run, or has no evaluation, is left out.
      folder: of the small files. What they have of the same task and machine is replaced.
    """
    rows: list[dict[str, Any]] = []
    returns: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for run in sorted(directory.iterdir()):
        if not (run / "summary.json").exists() or not (run / "metrics.csv").exists():
            continue
        config, summary = read_json(run / "config.json"), read_json(run / "summary.json")
        found = read_metrics(run / "metrics.csv")
        evaluated = found["eval_return"]
        times = read_columns(run / "metrics.csv", {"wall_seconds": np.float64})["wall_seconds"]
        times = times[: evaluated.size].reshape(evaluated.shape)[:, 0]
        if len(times) < 2:
            continue
        known = {
            "task": task_name(config),
            "device": _device(config),
            "root": config["seed"],
            "status": summary["status"],
            "commit": (config.get("git_commit") or "unknown")[:12],
            "seconds": times[-1],
            "compile_seconds": summary.get("compile_seconds", float("nan")),
        }
        minute = evaluated[np.searchsorted(times, MINUTE, "right") - 1]
        final = summary.get("final_test_returns", evaluated[-1])
        best, steps = np.fmax.reduce(evaluated), found["env_steps"][-1]
        rows += [
            known | {"seed": seed, "minute": a, "final": b, "best": c, "env_steps": d}
            for seed, (a, b, c, d) in enumerate(zip(minute, final, best, steps, strict=True))
        ]
        returns.setdefault((known["task"], known["device"]), []).append((times, evaluated))
    _replace(folder / _SEEDS, _COLUMNS, rows)
    _replace(folder / _CURVES, ("task", "device", *_CURVE), list(_curve_rows(returns)))
    for path in directory.glob("play/*.csv"):
        shutil.copyfile(path, folder / f"{_PLAYED}{path.name}")
    return [f"{task} on {device}: {len(found)} runs" for (task, device), found in returns.items()]


def task_name(config: dict[str, Any]) -> str:
    """Returns the task of a run, with how its policies were chosen, if they were."""
    race = config.get("race", 1)
    return config["env"] if race == 1 else f"{config['env']}, best of races of {race}"


def env_id(task: str) -> str:
    """Returns the environment id of what ``task_name`` returned."""
    return task.partition(",")[0]


def _device(config: dict[str, Any]) -> str:
    if config["device"] != "cpu":
        return str(config["device"])
    cores = config["cores"] or config["cpu_count"]
    return f"{config['cpu'].split(',')[0]}, {cores} of {config['cpu_count']} threads"


def _curve_rows(
    returns: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]],
) -> Iterable[dict[str, Any]]:
    for (task, device), runs in returns.items():
        first = max(times[1] for times, _ in runs)
        last = min(times[-1] for times, _ in runs)
        for second in np.geomspace(first, last, _POINTS) if last > first else ():
            at = np.concatenate(
                [x[np.searchsorted(times, second * (1 + 1e-9), "right") - 1] for times, x in runs]
            )
            numbers = (second, *estimate_mean(at))
            yield {"task": task, "device": device} | dict(zip(_CURVE, numbers, strict=True))


def _replace(path: Path, names: Sequence[str], rows: list[dict[str, Any]]) -> None:
    new = {(row["task"], row["device"]) for row in rows}
    kept = [row for row in _read(path) if (row["task"], row["device"]) not in new]
    texts = [
        {name: f"{row[name]:.7g}" if isinstance(row[name], float) else row[name] for name in names}
        for row in rows
    ]
    everything = sorted([*kept, *texts], key=lambda row: (row["task"], row["device"]))
    write_bytes(path, csv_text([names, *(map(row.get, names) for row in everything)]).encode())


def _read(path: Path) -> list[dict[str, str]]:
    return read(path) if path.exists() else []


def clock(folder: Path) -> list[Group]:
    """Returns what is kept of runs that were given a time, by task and machine."""
    groups = []
    rows = sorted(_read(folder / _SEEDS), key=lambda row: (row["task"], row["device"]))
    for (task, device), found in itertools.groupby(rows, lambda row: (row["task"], row["device"])):
        mine = list(found)
        minute, final, seconds, steps = (
            np.array([float(row[name]) for row in mine])
            for name in ("minute", "final", "seconds", "env_steps")
        )
        finished = np.array([row["status"] == "finished" for row in mine])
        minute = np.where((seconds <= MINUTE) & finished, final, minute)
        of_time = float(np.median(seconds))
        groups.append(Group(task, device, minute, final, of_time, steps.mean(), not finished.all()))
    return groups


def optimum(folder: Path) -> list[dict[str, str]]:
    """Returns what is kept of searches for the optimum, a row for each start."""
    return _read(folder / _OPTIMUM)


def racing(folder: Path) -> list[dict[str, str]]:
    """Returns what is kept of races beside independent runs, a row for each arm."""
    return _read(folder / _RACING)


def curves(folder: Path) -> dict[tuple[str, str], Columns]:
    """Returns by task and machine the columns ``seconds``, ``mean``, ``low`` and ``high``."""
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in _read(folder / _CURVES):
        found.setdefault((row["task"], row["device"]), []).append(row)
    return {
        key: {name: np.array([float(row[name]) for row in rows]) for name in _CURVE}
        for key, rows in found.items()
    }


def played(folder: Path) -> dict[str, Columns]:
    """Returns by task the episodes that were played of its runs, by column."""
    paths = {path.stem.removeprefix(_PLAYED): path for path in sorted(folder.glob(f"{_PLAYED}*"))}
    return {task: read_columns(path, _EPISODE) for task, path in paths.items()}


def write_played(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the returns of episodes; the columns are ``policy``, ``seed``, ``simulation``, ..."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, csv_text([_EPISODE, *(map(row.get, _EPISODE) for row in rows)]).encode())


def peers(path: Path) -> dict[tuple[str, str, str], dict[float, list[float]]]:
    """Returns by task, peer and threads, by budget (s), the mean return of each of its runs."""
    found: dict[tuple[str, str, str], dict[float, list[float]]] = {}
    for row in _read(path):
        threads = row["machine"].rpartition(", ")[2]
        budgets = found.setdefault((row["task"], row["peer"], threads), {})
        budgets.setdefault(float(row["budget_seconds"]), []).append(float(row["mean_return"]))
    return found


class Figure(NamedTuple):
    """A published figure: who reached which mean return, and with how many env steps."""

    algorithm: str
    mean: float
    env_steps: float


def published(path: Path, task: str, method: str) -> Figure | None:
    """Returns the best mean in published.csv, whatever the task's version.

    Args:
      path: published.csv.
      task: an environment id.
      method: an algorithm, such as "PPO", whose variants count, too; or the policies of many:
        "off-policy".
    """
    name = task.rpartition("-")[0]
    rows = [x for x in _read(path) if x["task"] == name]
    rows = [x for x in rows if x["policy"] == method or x["algorithm"].startswith(method)]
    if not rows:
        return None
    best = max(rows, key=lambda row: float(row["mean"]))
    algorithm = best["algorithm"].partition(" (")[0]
    return Figure(algorithm, float(best["mean"]), float(best["env_steps"]))
