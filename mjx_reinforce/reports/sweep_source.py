"""Reading the directory of a sweep."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import Header, read_arrays, read_json
from mjx_reinforce.reports.experiment import Configuration, Source, settings_in_words
from mjx_reinforce.reports.run_source import number_entry, read_columns, timings

#: What sweep.json says of the sweep itself; all else is its provenance.
_OWN = (
    *("status", "env", "threshold", "settings", "configurations"),
    *("compile_seconds", "run_seconds", "statistics_seconds"),
)
_COLUMNS = {"configuration": np.int64, "seed": np.int64, "nonfinite": np.int64}
_ARRAYS = ("configuration", "seed", "eval_return", "env_steps")


def read_sweep_source(directory: Path) -> Source:
    """Reads a sweep, which may go on or have been interrupted.

    Raises:
      ValueError: a file is missing or damaged: which, and what is wrong.
    """
    path = directory / "sweep.json"
    content = read_json(path)
    if not isinstance(content.get("env"), str):
        raise ValueError(f"{path} is damaged: env is {content.get('env')!r}")
    swept = _swept(content, path)
    curves = _read_curves(directory / "curves.npz")
    curves["nonfinite"] = _nonfinite(directory / "results.csv", curves)
    if not len(curves["seed"]):
        raise ValueError(f"{directory} has no results yet; wait for the first, or --resume it")
    parts = []
    for identity in np.unique(curves["configuration"]).tolist():
        if identity not in swept:
            raise ValueError(f"{path} is damaged: it does not name configuration {identity}")
        parts.append(_configuration(swept[identity], curves, identity))
    settings = content.get("settings")
    return Source(
        directory=directory,
        env=content["env"],
        threshold=number_entry(content, "threshold", path),
        configurations=parts,
        settings=settings if isinstance(settings, dict) else {},
        provenance={name: x for name, x in content.items() if name not in _OWN},
        timings=timings(content, path),
        status=str(content.get("status", "finished")),
    )


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
    arrays = read_arrays(path, lambda headers: _check_curves(headers, path))
    return {name: arrays[name] for name in _ARRAYS}


def _check_curves(arrays: Mapping[str, Header], path: Path) -> None:
    """Raises ValueError for what is not in a curves.npz, or is missing there."""
    for name in sorted(arrays.keys() - set(_ARRAYS)):
        raise ValueError(f"{path} is damaged: {name!a} is not an array of a sweep")
    for name in _ARRAYS:
        if name not in arrays:
            raise ValueError(f"{path} is damaged: it has no array {name}")
        if not np.issubdtype(arrays[name].dtype, np.number):
            raise ValueError(f"{path} is damaged: {name} holds no numbers")
    shape = arrays["eval_return"].shape
    expected = {
        name: shape if name in ("eval_return", "env_steps") else shape[1:] for name in _ARRAYS
    }
    for name, wanted in expected.items():
        if len(shape) != 2 or shape[0] < 1 or arrays[name].shape != wanted:
            raise ValueError(
                f"{path} is damaged: {name} has the shape {arrays[name].shape}, not {wanted}"
            )


def _nonfinite(path: Path, curves: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the non-finite updates [R] of the curves, as results.csv has them.

    Raises:
      ValueError: the file cannot be read, is damaged, or misses a seed that has a curve.
    """
    columns = read_columns(path, _COLUMNS)
    keys = zip(columns["configuration"].tolist(), columns["seed"].tolist(), strict=True)
    found = dict(zip(keys, columns["nonfinite"].tolist(), strict=True))
    wanted = list(zip(curves["configuration"].tolist(), curves["seed"].tolist(), strict=True))
    for configuration, seed in wanted:
        if (configuration, seed) not in found:
            raise ValueError(
                f"{path} is damaged: it has no row of configuration {configuration}, seed {seed}, "
                "whose curve is in curves.npz"
            )
    return np.array([found[key] for key in wanted], np.int64)


def _configuration(
    settings: dict[str, Any], curves: dict[str, np.ndarray], identity: int
) -> Configuration:
    rows = np.flatnonzero(curves["configuration"] == identity)
    return Configuration(
        label=settings_in_words(settings),
        settings=settings,
        eval_return=curves["eval_return"][:, rows].astype(float),
        env_steps=curves["env_steps"][:, rows].astype(np.int64),
        nonfinite=curves["nonfinite"][rows],
        seed=curves["seed"][rows].astype(np.int64),
    )
