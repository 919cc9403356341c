"""The rows of docs/benchmarks.csv: what was timed, where and when, and how fast each time."""

import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.kit import rows
from experiments.kit.places import DOCS

#: Where the tables and the figure of the documents find their numbers.
RAW = DOCS / "benchmarks.csv"
#: What a row says of the policy that plays.
UNTRAINED = "rollout, untrained 16-32 policy"
TRAINED = "rollout, trained policy"
COLUMNS: tuple[str, ...] = (
    *("date", "commit", "machine", "device", "jax", "task", "what", "engine", "precision"),
    *("batch", "steps", "settings", "compile_seconds", "env_steps_per_second"),
)


class Candidate(NamedTuple):
    """Something to time.

    row: what its row says of it so far
    run: plays once and waits for the end
    env_steps: how many env steps that is
    """

    row: dict[str, Any]
    run: Callable[[], Any]
    env_steps: int


def measure(
    candidates: list[Candidate], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> list[dict[str, Any]]:
    """Times all candidates in turn, several times; returns their rows, speeds in order."""
    times: list[list[float]] = [[] for _ in candidates]
    for repeat in range(repeats + 1):
        for candidate, taken in zip(candidates, times, strict=True):
            started = clock()
            candidate.run()
            if repeat:  # the first warms up
                taken.append(clock() - started)
    timed = []
    for candidate, taken in zip(candidates, times, strict=True):
        speeds = [candidate.env_steps / seconds for seconds in taken]
        timed.append(candidate.row | {"env_steps_per_second": speeds})
    return timed


def speed(row: dict[str, Any]) -> float:
    """Returns the median of a row's repetitions (env steps/s)."""
    return statistics.median(row["env_steps_per_second"])


def facts(date: str, commit: str) -> dict[str, str]:
    """Returns what all rows of a call say: when it began, of which commit, and on which machine."""
    return {"date": date, "commit": commit, "machine": rows.machine(), "jax": jax.__version__}


def append(path: Path, timed: Iterable[dict[str, Any]]) -> None:
    """Adds what was timed to a CSV file, in one write."""
    rows.append(path, map(_texts, timed), COLUMNS)


def _texts(row: dict[str, Any]) -> dict[str, Any]:
    speeds = " ".join(f"{speed:.4g}" for speed in row["env_steps_per_second"])
    compiling = row.get("compile_seconds")
    seconds = "" if compiling is None else f"{compiling:.1f}"
    texts = {"env_steps_per_second": speeds, "compile_seconds": seconds}
    return {key: row.get(key, "") for key in COLUMNS} | texts


def read(path: Path = RAW) -> list[dict[str, Any]]:
    """Returns the rows of a file, numbers as numbers."""
    timed = rows.read(path)
    for row in timed:
        row["batch"], row["steps"] = int(row["batch"]), int(row["steps"])
        row["env_steps_per_second"] = [float(x) for x in row["env_steps_per_second"].split()]
    return timed
