"""The small files in data: what is kept of runs, and what the page is made of."""

import math
import shutil
import tarfile
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.studies.results.measures import QUANTILES, curves, least_share_solved
from experiments.studies.results.runs import FACTOR, ended, swept
from experiments.studies.results.tasks import Task
from mjx_reinforce.files import csv_bytes, read_json, write_bytes, write_json
from mjx_reinforce.reports.run_source import PROVENANCE, read_columns, read_metrics
from mjx_reinforce.reports.statistics import finite_or_nan, iqm, iqm_interval, steps_to_solve
from mjx_reinforce.reports.statistics.aggregates import wilson
from mjx_reinforce.sweeps.run import read_results

#: The policies that are played, by rank in the final evaluation.
POLICIES = ("best", "median")
#: In a directory of stages, the small files of runs that stayed on another machine.
_GATHERED = "gathered"
#: What is packed of a run beside them: what playing its last policies needs.
_PLAYABLE = ("config.json", "summary.json", "policy/policy.json", "policy/actor.npz")
#: The env steps between which a solved seed should stay solved.
STAY_SOLVED = (200_000, 1_000_000)
_SEED_COLUMNS = (
    *("seed", "env_steps", "test_return", "final_return", "best_return"),
    "env_steps_to_solve",
)
_CURVE_COLUMNS = (
    *("env_steps", "iqm", "low", "high"),
    *(f"q{100 * q:g}" for q in QUANTILES),
    "solved",
)
_MOVED = {
    "setting": str,
    "value": str,
    "factor": float,
    "seeds": int,
    "env_steps": int,
    "cut_short": int,
    "own_starts": int,
}
_MOVED_RETURNS = ("iqm", "low", "high", "solved", "solved_low", "solved_high")
_PLAYED = {"policy": str, "seed": int, "simulation": str, "episode": int, "return": float}

Columns = dict[str, np.ndarray]


class Result(NamedTuple):
    """What is kept of a task.

    facts: of its run: settings, machine, times
    seeds: by column, [S] of each seed; ``env_steps_to_solve`` is inf where it never was;
      ``test_return`` is the last policy's on starts that nothing else used
    curve: by column, see ``measures.curves``
    moved: by column, a row for each configuration of its sweep; None if it was not swept
    played: by column, a row for each episode of the best and median policy; None if not played
    """

    task: Task
    facts: dict[str, Any]
    seeds: Columns
    curve: Columns
    moved: Columns | None
    played: Columns | None


def gather(tasks: Iterable[Task], directory: Path, folder: Path) -> None:
    """Writes the small files of those tasks whose runs have ended.

    Args:
      tasks: of the results.
      directory: of the stages.
      folder: of the small files; those of tasks that are not in the directory stay.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for task in tasks:
        run, packed = directory / task.name, directory / _GATHERED
        if ended(run) and (run / "metrics.csv").exists():
            _gather_run(run, task.name, folder)
        elif (packed / f"{task.name}.json").exists():
            for name in _run_files(task.name):
                shutil.copyfile(packed / name, folder / name)
        sweep = directory / "sensitivity" / task.name
        if swept(sweep):
            _write(folder / f"{task.name}-sensitivity.csv", _gather_sweep(sweep))
        played = directory / "play" / f"{task.name}.csv"
        if played.exists():
            shutil.copyfile(played, folder / f"{task.name}-play.csv")


def pack(tasks: Iterable[Task], directory: Path, path: Path) -> list[str]:
    """Writes an archive of what ``play`` and ``page`` need of those tasks whose runs have ended.

    Args:
      tasks: of the results.
      directory: of the stages.
      path: of the archive, which is to be unpacked in a directory of stages elsewhere.

    Returns:
      The names of the tasks that are in it.
    """
    names = [task.name for task in tasks if ended(directory / task.name)]
    with tarfile.open(path, "w:gz") as archive, tempfile.TemporaryDirectory() as folder:
        for name in names:
            _gather_run(directory / name, name, Path(folder))
            for file in _run_files(name):
                archive.add(Path(folder) / file, f"{_GATHERED}/{file}")
            for file in _PLAYABLE:
                archive.add(directory / name / file, f"{name}/{file}")
    return names


def load(tasks: Iterable[Task], folder: Path) -> list[Result | Task]:
    """Returns what is kept of each task, or the task itself where nothing is."""
    return [
        _load(task, folder) if (folder / f"{task.name}.json").exists() else task for task in tasks
    ]


def _run_files(name: str) -> tuple[str, ...]:
    return f"{name}.json", f"{name}-seeds.csv", f"{name}-curve.csv"


def _gather_run(run: Path, name: str, folder: Path) -> None:
    """Writes the facts, the seeds and the curve of a run."""
    config, summary = read_json(run / "config.json"), read_json(run / "summary.json")
    found, threshold = read_metrics(run / "metrics.csv"), summary["threshold"]
    returns, steps = found["eval_return"], found["env_steps"]
    solved = steps_to_solve(returns, steps, threshold)
    columns = {
        "seed": np.arange(returns.shape[1]),
        "env_steps": steps[-1],
        "test_return": summary["final_test_returns"],
        "final_return": returns[-1],
        "best_return": np.fmax.reduce(returns),
        "env_steps_to_solve": [math.inf if x is None else x for x in solved],
    }
    least = math.nan
    if threshold is not None:
        least = least_share_solved(returns, steps, threshold, *STAY_SOLVED)
    facts = {k: summary[k] for k in ("status", "threshold", "engine", "num_seeds")}
    facts |= {k: summary[k] for k in ("compile_seconds", "run_seconds")}
    facts |= {k: config[k] for k in PROVENANCE if k in config}
    facts |= {
        "nonfinite_updates": len(summary["nonfinite"]),
        "least_share_solved": least,
        "cut_short": int(np.sum(steps[-1] < config["env_steps"])),
        "evaluations": len(returns),
        "settings": {k: v for k, v in config.items() if k not in (*PROVENANCE, "output")},
    }
    facts_file, seeds_file, curve_file = (folder / file for file in _run_files(name))
    write_json(facts_file, facts)
    _write(seeds_file, columns)
    _write(curve_file, curves(returns, steps, threshold, config["env_steps"]))


def _gather_sweep(directory: Path) -> Columns:
    """Returns a row for each configuration of a sweep of ``OneAtATime``; the first is its base."""
    results, record = read_results(directory), read_json(directory / "sweep.json")
    threshold, budget = record["threshold"], record["settings"]["env_steps"]
    # Of sweeps from before there was that setting, all seeds have the same starts.
    base, rows, own = results.configurations[0], [], int("test_episodes" in record["settings"])
    for number, values in enumerate(results.configurations):
        name = next((name for name in base if values[name] != base[name]), None)
        final = results.eval_return[-1, results.configuration == number]
        low, high = iqm_interval(final)
        found = [math.nan] * 3
        if threshold is not None:
            found = wilson(int(np.sum(final >= threshold)), len(final))
        less = name is not None and values[name] < base[name]
        factor = 1 if name is None else 1 / FACTOR if less else FACTOR
        value = "" if name is None else f"{values[name]:.9g}"
        cut = int(np.sum(results.env_steps[-1, results.configuration == number] < budget))
        moved = name or "default", value, factor, len(final), budget, cut, own
        rows.append((*moved, iqm(final), low, high, *found))
    names = (*_MOVED, *_MOVED_RETURNS)
    return {name: np.array(x) for name, x in zip(names, zip(*rows, strict=True), strict=True)}


def _load(task: Task, folder: Path) -> Result:
    moved, played = (folder / f"{task.name}-{kind}.csv" for kind in ("sensitivity", "play"))
    kinds = _MOVED | dict.fromkeys(_MOVED_RETURNS, float)
    return Result(
        task=task,
        facts=read_json(folder / f"{task.name}.json"),
        seeds=read_columns(
            folder / f"{task.name}-seeds.csv", dict.fromkeys(_SEED_COLUMNS, np.float64)
        ),
        curve=read_columns(
            folder / f"{task.name}-curve.csv", dict.fromkeys(_CURVE_COLUMNS, np.float64)
        ),
        moved=read_columns(moved, kinds) if moved.exists() else None,
        played=read_played(played),
    )


def read_played(path: Path) -> Columns | None:
    """Returns the returns of episodes by column; None if there is no file."""
    return read_columns(path, _PLAYED) if path.exists() else None


def write_played(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the returns of episodes; the columns are ``policy``, ``seed``, ``simulation``, ..."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, csv_bytes(tuple(_PLAYED), rows))


def _write(path: Path, columns: Mapping[str, Any]) -> None:
    """Writes columns as a CSV file; float32 keep all their digits."""
    texts = ([_text(x) for x in np.asarray(values).tolist()] for values in columns.values())
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*texts, strict=True)]
    write_bytes(path, csv_bytes(tuple(columns), rows))


def _text(x: Any) -> str:
    return f"{x:.9g}" if isinstance(x, float) else str(x)


def own_starts(result: Result) -> bool:
    """Returns whether each seed was tested on starts of its own; once all had the same."""
    return "test_episodes" in result.facts["settings"]


def tested_episodes(result: Result) -> int:
    """Returns of how many episodes a seed's test was: whole evaluations."""
    settings = result.facts["settings"]
    a_round = settings["eval_episodes"]
    return -(-(settings.get("test_episodes") or a_round) // a_round) * a_round


def tested_returns(result: Result) -> np.ndarray:
    """Returns each seed's return [S] on starts that nothing else used, NaN of one that failed."""
    return finite_or_nan(result.seeds["test_return"])
