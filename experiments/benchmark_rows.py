"""The rows of docs/benchmarks.csv: what was timed, where and when, and how fast each time."""

import csv
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax

#: Where the tables and the figure of the documents find their numbers.
RAW = Path(__file__).parents[1] / "docs" / "benchmarks.csv"
COLUMNS: tuple[str, ...] = (
    "date",
    "commit",
    "machine",
    "device",
    "jax",
    "task",
    "what",
    "engine",
    "precision",
    "batch",
    "steps",
    "settings",
    "compile_seconds",
    "env_steps_per_second",
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


def measure(candidates: list[Candidate], repeats: int) -> list[dict[str, Any]]:
    """Times all candidates in turn, several times; returns their rows, speeds in order."""
    times: list[list[float]] = [[] for _ in candidates]
    for repeat in range(repeats + 1):
        for candidate, taken in zip(candidates, times, strict=True):
            started = time.perf_counter()
            candidate.run()
            if repeat:  # the first warms up
                taken.append(time.perf_counter() - started)
    rows = []
    for candidate, taken in zip(candidates, times, strict=True):
        speeds = [candidate.env_steps / seconds for seconds in taken]
        rows.append(candidate.row | {"env_steps_per_second": speeds})
    return rows


def speed(row: dict[str, Any]) -> float:
    """Returns the median of a row's repetitions (env steps/s)."""
    return statistics.median(row["env_steps_per_second"])


def facts(date: str, commit: str) -> dict[str, str]:
    """Returns what all rows of a call say: when it began, of which commit, and on which machine."""
    usable, present = threads(), os.cpu_count()
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    machine = f"{model}, {usable} of {present} threads"
    return {"date": date, "commit": commit, "machine": machine, "jax": jax.__version__}


def threads() -> int:
    """Returns how many threads this process may use at once."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def append(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Adds rows to a CSV file, in one write; a new file gets its first line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        for row in rows:
            speeds = " ".join(f"{speed:.4g}" for speed in row["env_steps_per_second"])
            compiling = row.get("compile_seconds")
            seconds = "" if compiling is None else f"{compiling:.1f}"
            texts = {"env_steps_per_second": speeds, "compile_seconds": seconds}
            writer.writerow({key: row.get(key, "") for key in COLUMNS} | texts)


def read(path: Path = RAW) -> list[dict[str, Any]]:
    """Returns the rows of a file, numbers as numbers."""
    with path.open(encoding="utf-8", newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row["batch"], row["steps"] = int(row["batch"]), int(row["steps"])
        row["env_steps_per_second"] = [float(x) for x in row["env_steps_per_second"].split()]
    return rows
