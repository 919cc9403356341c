"""Reading the directory of a run or a sweep, which may go on or have been interrupted."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import read_arrays, read_json
from mjx_reinforce.reports.experiment import Configuration, Source, settings_in_words
from mjx_reinforce.settings.config import read_seeds

#: What config.json says besides the settings.
PROVENANCE = (
    *("python", "packages", "git_commit", "device", "cpu", "machine_code", "jax_settings"),
    *("num_devices", "num_processes", "cpu_count", "cores", "x64", "xla_flags", "resumed"),
)
#: What sweep.json says of the sweep itself; all else is its provenance.
_OWN = (
    *("status", "env", "threshold", "settings", "configurations"),
    *("compile_seconds", "run_seconds", "statistics_seconds"),
)
_TIMINGS = ("compile_seconds", "run_seconds", "statistics_seconds")
#: The columns and arrays that are read, and their types.
_METRICS = {"seed": np.int64, "env_steps": np.int64, "eval_return": np.float64}
_RESULTS = {"configuration": np.int64, "seed": np.int64, "nonfinite": np.int64}
_CURVES = {"configuration": 1, "seed": 1, "eval_return": 2, "env_steps": 2}


def read_directory(directory: Path) -> Source:
    """Reads a run or a sweep.

    Raises:
      ValueError: it is neither, or a file is missing or damaged: which, and what is wrong.
    """
    if (directory / "sweep.json").is_file():
        return read_sweep(directory)
    if (directory / "config.json").is_file():
        return read_run(directory)
    if not directory.is_dir():
        raise ValueError(f"there is no directory {directory}; name that of a run or a sweep")
    raise ValueError(
        f"{directory} is neither a run nor a sweep: it has no config.json and no sweep.json"
    )


def read_run(directory: Path) -> Source:
    """Reads a run; raises as ``read_directory``."""
    path = directory / "config.json"
    config = read_json(path)
    env = _env(config, path)
    path = directory / "summary.json"
    summary = read_json(path) if path.exists() else {"status": "running"}
    seeds = config.get("seeds")
    first = read_seeds(seeds).start if isinstance(seeds, str) else 0
    columns = read_metrics(directory / "metrics.csv", first)
    seed = columns["seed"]
    part = Configuration(
        label=directory.name,
        settings={},
        nonfinite=_count_nonfinite(summary, path, seed),
        where=[directory] * len(seed),
        **columns,
    )
    kept = {name: value for name, value in config.items() if name in PROVENANCE}
    return Source(
        directory=directory,
        env=env,
        configurations=[part],
        settings={name: value for name, value in config.items() if name not in PROVENANCE},
        provenance=kept | {"engine": summary.get("engine", config.get("engine"))},
        **_outcome(summary, path),
    )


def read_sweep(directory: Path) -> Source:
    """Reads a sweep; raises as ``read_directory``."""
    path = directory / "sweep.json"
    content = read_json(path)
    env, swept = _env(content, path), _swept(content, path)
    curves = _read_curves(directory / "curves.npz")
    nonfinite = _nonfinite(directory / "results.csv", curves)
    if not len(nonfinite):
        raise ValueError(f"{directory} has no results yet; wait for the first, or --resume it")
    parts = []
    for identity in np.unique(curves["configuration"]).tolist():
        if identity not in swept:
            raise ValueError(f"{path} is damaged: it does not name configuration {identity}")
        runs = np.flatnonzero(curves["configuration"] == identity)
        part = Configuration(
            label=settings_in_words(swept[identity]),
            settings=swept[identity],
            eval_return=curves["eval_return"][:, runs].astype(float),
            env_steps=curves["env_steps"][:, runs].astype(np.int64),
            nonfinite=nonfinite[runs],
            seed=curves["seed"][runs].astype(np.int64),
            where=[directory] * len(runs),
        )
        parts.append(part)
    settings = content.get("settings")
    return Source(
        directory=directory,
        env=env,
        configurations=parts,
        settings=settings if isinstance(settings, dict) else {},
        provenance={name: x for name, x in content.items() if name not in _OWN},
        **_outcome(content, path),
    )


def _env(content: Mapping[str, Any], path: Path) -> str:
    """Returns the id of the environment that a file names."""
    if not isinstance(content.get("env"), str):
        raise ValueError(f"{path} is damaged: env is {content.get('env')!r}")
    return content["env"]


def _outcome(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Returns what a file says of ``threshold``, ``timings`` and ``status``."""
    seconds = {name: number_entry(content, name, path) for name in _TIMINGS}
    return {
        "threshold": number_entry(content, "threshold", path),
        "timings": {name: value for name, value in seconds.items() if value is not None},
        "status": str(content.get("status", "finished")),
    }


def number_entry(content: Mapping[str, Any], name: str, path: Path) -> float | None:
    """Returns an entry of a JSON file, a number or None.

    Raises:
      ValueError: it is something else.
    """
    value = content.get(name)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise ValueError(f"{path} is damaged: {name} is {value!r}, not a number")
    return None if value is None else float(value)


def _count_nonfinite(summary: dict[str, Any], path: Path, seed: np.ndarray) -> np.ndarray:
    """Returns how many updates of each seed [S] met numbers that are not finite."""
    try:
        seeds = np.array([event["seed"] for event in summary.get("nonfinite", [])], np.int64)
        return np.bincount(seeds - seed[0], minlength=len(seed))[: len(seed)]
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is damaged: nonfinite is no list of updates") from error


def _swept(content: dict[str, Any], path: Path) -> dict[int, dict[str, Any]]:
    """Returns the swept settings of each configuration by its number."""
    try:
        return {
            int(entry["configuration"]): {k: v for k, v in entry.items() if k != "configuration"}
            for entry in content["configurations"]
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged: configurations is no list of settings with their number"
        ) from error


def _read_curves(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of curves.npz."""
    arrays = read_arrays(path)
    if arrays.keys() != _CURVES.keys():
        raise ValueError(
            f"{path} is damaged: it has the arrays {', '.join(map(ascii, arrays))}, and should "
            f"have {', '.join(_CURVES)}"
        )
    shape = arrays["eval_return"].shape
    for name, axes in _CURVES.items():
        array, wanted = arrays[name], shape[-axes:]
        numbers = np.issubdtype(array.dtype, np.number)
        if not numbers or len(shape) != 2 or shape[0] < 1 or array.shape != wanted:
            raise ValueError(
                f"{path} is damaged: {name} must be numbers of the shape {wanted}, got "
                f"{array.dtype} {array.shape}"
            )
    return arrays


def _nonfinite(path: Path, curves: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the non-finite updates [R] of the curves, as results.csv has them.

    Raises:
      ValueError: the file cannot be read, is damaged, or misses a seed that has a curve.
    """
    columns = read_columns(path, _RESULTS)
    keys = zip(columns["configuration"].tolist(), columns["seed"].tolist(), strict=True)
    found = dict(zip(keys, columns["nonfinite"].tolist(), strict=True))
    wanted = list(zip(curves["configuration"].tolist(), curves["seed"].tolist(), strict=True))
    if missing := [key for key in wanted if key not in found]:
        configuration, seed = missing[0]
        raise ValueError(
            f"{path} is damaged: it has no row of configuration {configuration}, seed {seed}, "
            "whose curve is in curves.npz"
        )
    return np.array([found[key] for key in wanted], np.int64)


def read_metrics(path: Path, first: int = 0) -> dict[str, np.ndarray]:
    """Returns the columns ``env_steps`` and ``eval_return`` of a metrics.csv, and ``seed`` [S].

    The columns are [E, S], of S seeds from ``first`` on.

    A last line or evaluation that is not whole, which a killed run may leave, is left out.

    Raises:
      ValueError: the file cannot be read, a column is missing, an entry is no number, or the rows
        are not in the order of the seeds.
    """
    columns = read_columns(path, _METRICS)
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


def read_columns(path: Path, kinds: Mapping[str, Any]) -> dict[str, np.ndarray]:
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
    header, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]
    for name in kinds:
        if name not in header:
            raise ValueError(f"{path} is damaged: it has no column {name}")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise ValueError(
                f"{path} is damaged: line {line} has {len(row)} entries, not {len(header)}"
            )
    found = {}
    for name, kind in kinds.items():
        column = header.index(name)
        try:
            found[name] = np.array([row[column] for row in rows], dtype=kind)
        except ValueError as error:  # it has the text
            raise ValueError(f"{path} is damaged: in the column {name}, {error}") from None
    return found
