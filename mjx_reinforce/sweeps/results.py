"""The files of a sweep: DIR/sweep.json, results.csv, curves.npz, and the parts of them so far.

A part is what one chunk of runs measured. It is written whole, when the chunk ends, and is all that
results.csv and curves.npz are made of: all else that a crash leaves is written again.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.export.policy_files import actor_of, arrays_of, save_policy
from mjx_reinforce.files import Arrays, read_arrays, write_arrays, write_bytes, write_json
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.statistics import steps_to_solve
from mjx_reinforce.sweeps.chunks import ChunkRecord, Runs
from mjx_reinforce.training import checkpoint

_MEASURED = (
    *("seed", "final_return", "best_return", "env_steps_to_solve"),
    *("env_steps", "nonfinite"),
)
_RESULT_FILES = ("sweep.json", "results.csv", "curves.npz")


class SweepFiles:
    """Writes the files of a sweep into its directory; each method raises OSError if that fails."""

    def __init__(
        self,
        directory: Path,
        configurations: Sequence[Mapping[str, Any]],
        threshold: float | None,
    ):
        """Takes what the rows of results.csv are made of.

        Args:
          directory: where.
          configurations: the values of what is swept, in each.
          threshold: the return that counts as solved, if any.
        """
        self.directory, self.parts = directory, directory / "parts"
        self._configurations = [[*map(_spelled, x.values())] for x in configurations]
        self._threshold = threshold
        self._columns = ("configuration", *configurations[0], *_MEASURED)

    def open(self, contents: Mapping[str, Any]) -> None:
        """Begins, or takes results.csv back to the parts that are there.

        Of a new sweep sweep.json is first: where that cannot be written, nothing was begun.

        Args:
          contents: of sweep.json.
        """
        self.write(contents)
        self._take_back()

    def _take_back(self) -> None:
        """Takes results.csv back to the parts that are there, and removes what a crash left."""
        self.parts.mkdir(exist_ok=True)
        for folder, names in ((self.directory, _RESULT_FILES), (self.parts, ("*.npz",))):
            for path in (path for name in names for path in folder.glob(f".{name}.*")):
                path.unlink()
        measured = self._all()
        self._write_rows(self._rows(measured) if measured else [])

    def write(self, contents: Mapping[str, Any]) -> None:
        """Writes sweep.json."""
        write_json(self.directory / "sweep.json", contents)

    def has(self, chunk: str) -> bool:
        """Returns whether a chunk has ended."""
        return self._path(chunk).exists()

    def checkpoints(self, chunk: str) -> Path:
        """Returns the folder of a chunk's checkpoints."""
        return self.parts / chunk

    def add(self, runs: Runs, record: ChunkRecord, actors: Actor) -> None:
        """Writes the part of a chunk, after its policies, and appends its rows to results.csv.

        Args:
          runs: R of them, the chunk's.
          record: what they measured.
          actors: [R, ...] their last policies, of which the best and the worst are kept.
        """
        final = record.latest()["eval_return"].astype(np.float64)
        facts = {"configuration": runs.configuration, "seed": runs.seed, "final_return": final}
        policies = {f"actor/{name}": np.asarray(x) for name, x in arrays_of(actors).items()}
        write_arrays(self.parts / f"policies-{runs.name}.npz", _ends(facts | policies))
        curves = record.curves()
        part = {
            "configuration": runs.configuration.astype(np.int32),
            "seed": runs.seed.astype(np.int32),
            "eval_return": curves["eval_return"].astype(np.float32),
            "env_steps": curves["env_steps"].astype(np.int64),
            "nonfinite": record.nonfinite.astype(np.int32),
        }
        write_arrays(self._path(runs.name), part)
        files.append(self.directory / "results.csv", files.csv_text(self._rows(part)).encode())

    def finish(self) -> None:
        """Joins the parts so far to results.csv and curves.npz, sorted by configuration."""
        if joined := self._all():
            self._write_rows(self._rows(joined))
            del joined["nonfinite"]
            write_arrays(self.directory / "curves.npz", joined, compressed=True)

    def gather_policies(
        self, settings: Callable[[int], tuple[dict[str, Any], dict[str, Any]]]
    ) -> None:
        """Writes the folder ``policies`` of a sweep that ended.

        Args:
          settings: the number of a configuration -> those of its policy, and what config.json
            says beside its seeds.
        """
        shutil.rmtree(self.directory / "policies", ignore_errors=True)
        kept = [read_arrays(path) for path in sorted(self.parts.glob("policies-[0-9]*.npz"))]
        for number in np.unique(np.concatenate([part["configuration"] for part in kept])).tolist():
            place = self.directory / "policies" / f"{number:03d}"
            arrays = _ends(_parts_of(kept, number))
            actors = {k.removeprefix("actor/"): x for k, x in arrays.items() if "/" in k}
            policy, run = settings(number)
            save_policy(place / "policy", actor_of(actors), policy)
            returns = arrays["final_return"].tolist()
            write_json(place / "summary.json", {"status": "finished", "final_returns": returns})
            write_json(place / "config.json", run | {"seeds": arrays["seed"].tolist()})

    def remove_states(self) -> None:
        """Removes what a sweep needs only while it goes on."""
        for path in self.parts.glob("policies-*.npz"):
            path.unlink()
        for folder in self.parts.glob("*/"):
            checkpoint.remove_checkpoints(folder)

    def _path(self, chunk: str) -> Path:
        return self.parts / f"{chunk}.npz"

    def _all(self) -> Arrays:
        """Returns what all chunks measured so far, sorted; empty if nothing."""
        paths = sorted(self.parts.glob("[0-9]*.npz"))
        return join_parts([*map(read_arrays, paths)]) if paths else {}

    def _write_rows(self, rows: Sequence[Sequence[Any]]) -> None:
        """Replaces results.csv at once."""
        text = files.csv_text([self._columns, *rows])
        write_bytes(self.directory / "results.csv", text.encode())

    def _rows(self, part: Arrays) -> list[list[Any]]:
        """Returns the rows of results.csv of a part."""
        returns, env_steps = part["eval_return"], part["env_steps"]
        measured = (  # as in ``_MEASURED``
            part["seed"].tolist(),
            returns[-1].tolist(),
            np.fmax.reduce(returns).tolist(),
            steps_to_solve(returns, env_steps, self._threshold),
            env_steps[-1].tolist(),
            part["nonfinite"].tolist(),
        )
        return [
            [number, *self._configurations[number], *row]
            for number, *row in zip(part["configuration"].tolist(), *measured, strict=True)
        ]


def _ends(arrays: Arrays) -> Arrays:
    """Returns the worst and the best run of each configuration, in the order of their seeds."""
    values = np.nan_to_num(arrays["final_return"], nan=-np.inf)
    chosen = set()
    for number in np.unique(arrays["configuration"]):
        runs = np.flatnonzero(arrays["configuration"] == number)
        runs = runs[np.argsort(arrays["seed"][runs])]
        chosen |= {int(runs[values[runs].argmin()]), int(runs[values[runs].argmax()])}
    index = sorted(chosen, key=lambda i: (arrays["configuration"][i], arrays["seed"][i]))
    return {name: x[index] for name, x in arrays.items()}


def _parts_of(parts: Sequence[Arrays], number: int) -> Arrays:
    """Returns what several parts have of one configuration."""
    parts = [part for part in parts if np.any(part["configuration"] == number)]
    return {
        name: np.concatenate([part[name][part["configuration"] == number] for part in parts])
        for name in parts[0]
    }


def join_parts(parts: Sequence[Arrays]) -> Arrays:
    """Returns several parts as one, sorted by configuration and seed.

    A run whose evaluations ended earlier repeats its last.
    """
    length = max(len(part["eval_return"]) for part in parts)

    def joined(name: str) -> np.ndarray:
        each = [part[name] for part in parts]
        return np.concatenate([lengthened(x, length) if x.ndim > 1 else x for x in each], axis=-1)

    order = np.lexsort((joined("seed"), joined("configuration")))
    return {name: joined(name)[..., order] for name in parts[0]}


def _spelled(value: Any) -> Any:
    """Returns a value for a CSV file: lists as on the command line, None as such."""
    if isinstance(value, tuple):
        return ",".join(map(str, value)) or "none"
    return "None" if value is None else value
