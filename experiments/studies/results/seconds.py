"""Returns against seconds: what is kept of runs that were given a time, and who else had as long.

``gather`` reads directories of runs (DIR/ANY-NAME, each of ``mjx_reinforce.train``) and adds them
to two small files: seconds.csv has a row for each seed, seconds-curves.csv the mean over the seeds
of a task on a machine, at times on a logarithmic grid. What ``play DIR`` played of them
goes to seconds-play-TASK.csv.
"""

import itertools
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.kit.rows import read
from experiments.studies.results.files import Columns, read_played
from mjx_reinforce.files import csv_bytes, read_json, write_bytes
from mjx_reinforce.reports.run_source import read_columns, read_metrics
from mjx_reinforce.reports.statistics.aggregates import interval

#: A budget of everybody (s).
MINUTE = 60.0
_SEEDS, _CURVES, _PLAYED = "seconds.csv", "seconds-curves.csv", "seconds-play-"
_NOISE = "seconds-noise.csv"
#: Parts of a run, by updates, over which the gradient's noise is summed up.
PARTS = 4
_NUMBERS = ("minute", "final", "best", "seconds", "env_steps", "compile_seconds")
_KEYS = ("task", "device", "root", "seed", "status", "commit")
_CURVE_NUMBERS = ("seconds", "mean", "low", "high")
_POINTS = 40


class Group(NamedTuple):
    """The runs of one task on one machine.

    task, device: which; the device in words
    minute: each seed's return [S] at its last evaluation within ``MINUTE``; of a run that ended
      within it, on fresh starts
    final: each seed's return [S] at the end, on fresh starts; of a run that was stopped, at its
      last evaluation
    seconds: training time of all seeds together, evaluations included; the median of several runs
    env_steps: a seed's, the mean
    stopped: whether a run was stopped before its end
    rows: of the file
    """

    task: str
    device: str
    minute: np.ndarray
    final: np.ndarray
    seconds: float
    env_steps: float
    stopped: bool
    rows: list[dict[str, str]]


def gather(directory: Path, folder: Path) -> list[str]:
    """Adds the runs of a directory to the small files; returns what was added, in words.

    Args:
      directory: of runs; what is no run, or has no evaluation, is left out.
      folder: of the small files. What they have of the same task and machine is replaced.
    """
    rows: list[dict[str, Any]] = []
    noise: list[dict[str, Any]] = []
    returns: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for run in sorted(directory.iterdir()):
        if not (run / "summary.json").exists() or not (run / "metrics.csv").exists():
            continue
        config, summary = read_json(run / "config.json"), read_json(run / "summary.json")
        times, steps, evaluated = _evaluations(run / "metrics.csv")
        if len(times) < 2:
            continue
        known = {
            "task": config["env"],
            "device": _device(config),
            "root": config["seed"],
            "status": summary["status"],
            "commit": (config.get("git_commit") or "unknown")[:12],
            "seconds": times[-1],
            "compile_seconds": summary.get("compile_seconds", float("nan")),
        }
        minute = evaluated[np.searchsorted(times, MINUTE, "right") - 1]
        final = summary.get("final_test_returns", evaluated[-1])
        best = np.fmax.reduce(evaluated)
        rows += [
            known | {"seed": seed, "minute": a, "final": b, "best": c, "env_steps": d}
            for seed, (a, b, c, d) in enumerate(zip(minute, final, best, steps[-1], strict=True))
        ]
        noise += _noise_rows(run / "metrics.csv", known, config["num_episodes"])
        returns.setdefault((known["task"], known["device"]), []).append((times, evaluated))
    _replace(folder / _SEEDS, (*_KEYS, *_NUMBERS), rows)
    _replace(folder / _CURVES, ("task", "device", *_CURVE_NUMBERS), list(_curve_rows(returns)))
    _replace(folder / _NOISE, ("task", "device", "root", "episodes", "part", "snr"), noise)
    for path in directory.glob("play/*.csv"):
        shutil.copyfile(path, folder / f"{_PLAYED}{path.name}")
    return [f"{task} on {device}: {len(found)} runs" for (task, device), found in returns.items()]


def _evaluations(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns when evaluations were [E] (s of training), env steps and returns [E, S]."""
    found = read_metrics(path)
    returns = found["eval_return"]
    seconds = read_columns(path, {"wall_seconds": np.float64})["wall_seconds"]
    return seconds[: returns.size].reshape(returns.shape)[:, 0], found["env_steps"], returns


def _noise_rows(path: Path, known: dict[str, Any], episodes: int | str) -> list[dict[str, Any]]:
    """Returns of each part of a run the median ``gradient_snr`` over evaluations and seeds."""
    snr = [float(row["gradient_snr"]) for row in _read(path) if row.get("gradient_snr")]
    shared = {name: known[name] for name in ("task", "device", "root")} | {"episodes": episodes}
    parts = np.array_split(np.array(snr), PARTS) if len(snr) >= PARTS else []
    return [shared | {"part": i, "snr": float(np.median(x))} for i, x in enumerate(parts)]


def noise(folder: Path) -> list[dict[str, str]]:
    """Returns the rows on the gradient's noise: ``episodes`` of an update, ``part``, ``snr``."""
    return _read(folder / _NOISE)


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
        if last <= first:
            continue
        for second in np.geomspace(first, last, _POINTS):
            at = np.concatenate(
                [x[np.searchsorted(times, second * (1 + 1e-9), "right") - 1] for times, x in runs]
            )
            found = interval("mean", at)
            numbers = (second, found.value, found.low, found.high)
            yield {"task": task, "device": device} | dict(zip(_CURVE_NUMBERS, numbers, strict=True))


def _replace(path: Path, names: Sequence[str], rows: list[dict[str, Any]]) -> None:
    new = {(row["task"], row["device"]) for row in rows}
    kept = [row for row in _read(path) if (row["task"], row["device"]) not in new]
    texts = [
        {name: f"{row[name]:.7g}" if isinstance(row[name], float) else row[name] for name in names}
        for row in rows
    ]
    everything = sorted([*kept, *texts], key=lambda row: (row["task"], row["device"]))
    write_bytes(path, csv_bytes(tuple(names), everything))


def _read(path: Path) -> list[dict[str, str]]:
    return read(path) if path.exists() else []


def load(folder: Path) -> list[Group]:
    """Returns what is kept, by task and machine."""
    groups = []
    rows = sorted(_read(folder / _SEEDS), key=lambda row: (row["task"], row["device"]))
    for (task, device), found in itertools.groupby(rows, lambda row: (row["task"], row["device"])):
        mine = list(found)
        minute, final, seconds, steps = (
            np.array([float(row[name]) for row in mine])
            for name in ("minute", "final", "seconds", "env_steps")
        )
        over = (seconds <= MINUTE) & np.array([row["status"] == "finished" for row in mine])
        minute = np.where(over, final, minute)
        stopped = any(row["status"] != "finished" for row in mine)
        of_time = float(np.median(seconds))
        groups.append(Group(task, device, minute, final, of_time, steps.mean(), stopped, mine))
    return groups


def curves(folder: Path) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Returns by task and machine the columns ``seconds``, ``mean``, ``low`` and ``high``."""
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in _read(folder / _CURVES):
        found.setdefault((row["task"], row["device"]), []).append(row)
    return {
        key: {name: np.array([float(row[name]) for row in rows]) for name in _CURVE_NUMBERS}
        for key, rows in found.items()
    }


def played(folder: Path) -> dict[str, Columns]:
    """Returns by task what was played of its runs."""
    paths = {path.stem.removeprefix(_PLAYED): path for path in sorted(folder.glob(f"{_PLAYED}*"))}
    found = {task: read_played(path) for task, path in paths.items()}
    return {task: columns for task, columns in found.items() if columns is not None}


def peers(path: Path) -> dict[tuple[str, str, str], dict[float, list[float]]]:
    """Returns by task, peer and threads, by budget (s), the mean return of each of its runs."""
    found: dict[tuple[str, str, str], dict[float, list[float]]] = {}
    for row in _read(path):
        threads = row["machine"].rpartition(", ")[2]
        budgets = found.setdefault((row["task"], row["peer"], threads), {})
        budgets.setdefault(float(row["budget_seconds"]), []).append(float(row["mean_return"]))
    return found


class Figure(NamedTuple):
    """A published figure: a mean return, who reached it, and with how many env steps."""

    mean: float
    source: str
    env_steps: float


def published(path: Path, task: str, algorithm: str) -> Figure | None:
    """Returns the best published mean of an algorithm on a task, whatever its version.

    Args:
      path: of published.csv.
      task: an environment's id.
      algorithm: "PPO" or "SAC".
    """
    name = task.rpartition("-")[0]
    rows = [x for x in _read(path) if x["task"] == name and x["algorithm"].startswith(algorithm)]
    if not rows:
        return None
    best = max(rows, key=lambda row: float(row["mean"]))
    return Figure(float(best["mean"]), best["implementation"], float(best["env_steps"]))
