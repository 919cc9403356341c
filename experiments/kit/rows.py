"""CSV files of what was measured: a row for each measurement, and its origin."""

import csv
import datetime
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.kit.places import ROOT


def read(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of a file, every value as text."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows, which have the same columns."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def append(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Adds rows to a file, in one write; a new file gets its first line.

    Raises:
      ValueError: a row has a column that the file has not, or lacks one.
    """
    rows = list(rows)
    for row in rows:
        if set(row) != set(columns):
            raise ValueError(f"columns that do not fit: {sorted(set(row) ^ set(columns))}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerows(rows)


def rounded(row: Mapping[str, Any], digits: int) -> dict[str, Any]:
    """Returns a row with its floating point numbers as text of so many significant digits."""
    return {k: f"{x:.{digits}g}" if isinstance(x, float) else x for k, x in row.items()}


def words(settings: Mapping[str, Any]) -> str:
    """Returns settings as text: "num_envs=1, normalize=True"."""
    return ", ".join(f"{name}={value}" for name, value in settings.items())


def now() -> str:
    """Returns the local time."""
    return datetime.datetime.now().isoformat(timespec="seconds")


def commit() -> str:
    """Returns the commit of this checkout, in short."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def threads() -> int:
    """Returns how many threads this process may use at once."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared_clock() -> float:
    """Returns the seconds that this process's threads have computed, divided by their number."""
    return time.process_time() / threads()


def machine() -> str:
    """Returns the processor, and how many of its threads this process may use."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return f"{model}, {threads()} of {os.cpu_count()} threads"
