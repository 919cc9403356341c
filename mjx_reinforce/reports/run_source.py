"""Reading the directory of a training run."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.files import read_json
from mjx_reinforce.reports.experiment import Configuration, Source
from mjx_reinforce.settings.config import read_seeds

#: What config.json says besides the settings.
PROVENANCE = (
    *("python", "packages", "git_commit", "device", "cpu", "machine_code", "jax_settings"),
    *("num_devices", "num_processes", "cpu_count", "cores", "x64", "xla_flags", "resumed"),
)
_METRICS_COLUMNS = {"seed": np.int64, "env_steps": np.int64, "eval_return": np.float64}


def read_run_source(directory: Path) -> Source:
    """Reads a run, which may go on or have been interrupted.

    Raises:
      ValueError: a file is missing or damaged: which, and what is wrong.
    """
    config = read_json(directory / "config.json")
    if not isinstance(config.get("env"), str):
        raise ValueError(f"{directory / 'config.json'} is damaged: env is {config.get('env')!r}")
    path = directory / "summary.json"
    summary = read_json(path) if path.exists() else {"status": "running"}
    seeds = config.get("seeds")
    first = read_seeds(seeds).start if isinstance(seeds, str) else 0
    columns = read_metrics(directory / "metrics.csv", first)
    num_seeds = columns["eval_return"].shape[1]
    settings = {name: value for name, value in config.items() if name not in PROVENANCE}
    kept = {name: value for name, value in config.items() if name in PROVENANCE}
    part = Configuration(
        label=directory.name,
        settings={},
        eval_return=columns["eval_return"],
        env_steps=columns["env_steps"],
        nonfinite=_count_nonfinite(summary, path, columns["seed"]),
        seed=columns["seed"],
        where=[directory] * num_seeds,
    )
    return Source(
        directory=directory,
        env=config["env"],
        threshold=number_entry(summary, "threshold", path),
        configurations=[part],
        settings=settings,
        provenance=kept | {"engine": summary.get("engine", config.get("engine"))},
        timings=timings(summary, path),
        status=str(summary.get("status", "finished")),
    )


def read_metrics(path: Path, first: int = 0) -> dict[str, np.ndarray]:
    """Returns the columns ``env_steps`` and ``eval_return`` of a metrics.csv, and ``seed`` [S].

    The columns are [E, S], of S seeds from ``first`` on.

    A last line or evaluation that is not whole, which a killed run may leave, is left out.

    Raises:
      ValueError: the file cannot be read, a column is missing, an entry is no number, or the rows
        are not in the order of the seeds.
    """
    columns = read_columns(path, _METRICS_COLUMNS)
    seed = columns["seed"]
    if not len(seed):
        raise ValueError(f"{path} has no evaluation yet; wait for the first, or train again")
    num_seeds = max(int(seed.max()) - first, 0) + 1
    whole = len(seed) // num_seeds * num_seeds
    wrong = np.flatnonzero(seed != first + np.arange(len(seed)) % num_seeds)
    if len(wrong) or not whole:
        row = int(wrong[0]) if len(wrong) else len(seed)
        expected = first + row % num_seeds
        raise ValueError(f"{path} is damaged: line {row + 2} is not of seed {expected}")
    shape = (-1, num_seeds)
    found = {name: columns[name][:whole].reshape(shape) for name in ("env_steps", "eval_return")}
    return found | {"seed": seed[:num_seeds]}


def read_columns(path: Path, kinds: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns columns of a CSV file by name; a last line that is not whole is left out.

    Args:
      path: of the file, whose first line has the names of the columns.
      kinds: the type of each column that is wanted.

    Raises:
      ValueError: the file cannot be read, a column is missing, a row too short or long, or an entry
        not of its type.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot read {path} ({reason})") from error
    rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    header = rows[0] if rows else []
    for name in kinds:
        if name not in header:
            raise ValueError(f"{path} is damaged: it has no column {name}")
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise ValueError(
                f"{path} is damaged: line {line} has {len(row)} entries, not {len(header)}"
            )
    found = {}
    for name, kind in kinds.items():
        i = header.index(name)
        texts = [row[i] for row in rows[1:]]
        try:
            found[name] = np.array(texts, dtype=kind)
        except ValueError:
            line = next(n for n, text in enumerate(texts, start=2) if not _reads_as(kind, text))
            raise ValueError(
                f"{path} is damaged: {name} in line {line} is {texts[line - 2]!r}"
            ) from None
    return found


def _reads_as(kind: DTypeLike, text: str) -> bool:
    try:
        np.array([text], dtype=kind)
    except ValueError:
        return False
    return True


def _count_nonfinite(summary: dict[str, Any], path: Path, seed: np.ndarray) -> np.ndarray:
    """Returns how many updates of each seed [S] met numbers that are not finite."""
    events = summary.get("nonfinite", [])
    try:
        seeds = np.array([event["seed"] for event in events], np.int64) - seed[0]
        return np.bincount(seeds, minlength=len(seed))[: len(seed)]
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is damaged: nonfinite is no list of updates") from error


def number_entry(content: dict[str, Any], name: str, path: Path) -> float | None:
    """Returns an entry of a JSON file, a number or None.

    Raises:
      ValueError: it is something else.
    """
    value = content.get(name)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise ValueError(f"{path} is damaged: {name} is {value!r}, not a number")
    return None if value is None else float(value)


def timings(content: dict[str, Any], path: Path) -> dict[str, float]:
    """Returns the seconds that a JSON file gives for compiling, running and statistics."""
    names = ("compile_seconds", "run_seconds", "statistics_seconds")
    found = {name: number_entry(content, name, path) for name in names}
    return {name: seconds for name, seconds in found.items() if seconds is not None}
