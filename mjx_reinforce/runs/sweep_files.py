"""The files of a sweep: DIR/sweep.json, results.csv, curves.npz, and the parts of them so far.

A part is what one chunk of runs measured. It is written whole, when the chunk ends, and is all that
results.csv and curves.npz are made of: all else that a crash leaves is written again.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.console.commands import typed
from mjx_reinforce.export.policy_files import actor_of, arrays_of, save_policy
from mjx_reinforce.files import Arrays, read_arrays, write_arrays, write_bytes, write_json
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs.design import as_record, configure
from mjx_reinforce.runs.plan import Prepared
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.statistics import steps_to_solve
from mjx_reinforce.store.provenance import provenance
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.driver import Training
from mjx_reinforce.training.record import ChunkRecord, Runs

_MEASURED = (
    *("seed", "final_return", "best_return", "env_steps_to_solve"),
    *("env_steps", "nonfinite"),
)


class SweepFiles(Files[Training]):
    """Writes the files of a sweep into its directory; raises OSError if one that lasts fails."""

    _folders = ("parts",)

    def __init__(self, directory: Path, prepared: Prepared, say: Callable[[str], None]):
        """Takes the files of a sweep, before they are there.

        Args:
          directory: where they are.
          prepared: what the sweep is made of.
          say: shows a line to the user.
        """
        self._prepared, self._configurations = prepared, prepared.design.configurations()
        super().__init__(directory, self._contents(), say)
        self._parts = directory / "parts"
        self._columns = ("configuration", *self._configurations[0], *_MEASURED)

    def _contents(self) -> dict[str, Any]:
        """Returns what sweep.json says while the sweep goes on."""
        design, parts, known = self._prepared.design, self._prepared.parts, self._prepared.known
        return {
            "status": "running",
            "env": design.base.env,
            "threshold": parts[0].ready.threshold,
            **as_record(design),
            "num_seeds": design.base.num_seeds,
            "configurations": [
                {"configuration": number, **values}
                for number, values in enumerate(self._configurations)
            ],
            "chunk_runs": [part.limit for part in parts],
            "local_devices": self._prepared.division.count,
            "engine": parts[0].ready.engine,
            "compile_seconds": known.get("compile_seconds", 0.0),
            "run_seconds": known.get("run_seconds", 0.0),
            "command": known.get("command", typed("sweep")),
            **provenance(),
        }

    def open(self) -> None:
        """Begins, or takes results.csv back to the parts that are there.

        Of a new sweep sweep.json is first: where that cannot be written, nothing was begun.
        """
        self._write_json("sweep.json", self.contents)
        super().open()
        self._parts.mkdir(exist_ok=True)
        measured = self._all()
        self._write_rows(self._rows(measured) if measured else [])

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of a chunk have ended."""
        return self._path(chunk).exists()

    def began(self, driver: Training) -> None:
        """Takes a chunk to its newest checkpoint, if there is one."""
        found = checkpoint.read_checkpoints(self._folder(driver), self._say)
        self._go_on(driver, next(found, None))

    def ended(self, driver: Training) -> None:
        """Writes what a chunk measured, or a checkpoint of one that was interrupted."""
        if not driver.record.done():
            super().ended(driver)
            return
        record = driver.record
        assert isinstance(record, ChunkRecord)
        self._add(record.runs, record, driver.slots.states().train_states.actor)
        checkpoint.remove_checkpoints(self._folder(driver))

    def finished(self, driver: Training, summary: dict[str, Any]) -> None:
        """Joins the parts so far to results.csv and curves.npz, sorted; sweep.json is last."""
        if joined := self._all():
            self._write_rows(self._rows(joined))
            del joined["nonfinite"]
            write_arrays(self._directory / "curves.npz", joined, compressed=True)
        if summary["status"] == "finished":
            self._gather_policies()
        self._write_json("sweep.json", summary)
        if summary["status"] == "finished":
            for path in self._parts.glob("policies-*.npz"):
                path.unlink()
            for folder in self._parts.glob("*/"):
                checkpoint.remove_checkpoints(folder)

    def _save_checkpoint(self, driver: Training) -> None:
        checkpoint.save(self._folder(driver), driver.checkpoint(), even=False)

    def _folder(self, driver: Training) -> Path:
        """Returns the folder of a chunk's checkpoints."""
        assert isinstance(driver.record, ChunkRecord)
        return self._parts / driver.record.runs.name

    def _add(self, runs: Runs, record: ChunkRecord, actors: Actor) -> None:
        """Writes the part of a chunk, after its policies, and appends its rows to results.csv.

        Args:
          runs: R of them, the chunk's.
          record: what they measured.
          actors: [R, ...] their last policies, of which the best and the worst are kept.
        """
        final = record.latest()["eval_return"].astype(np.float64)
        facts = {"configuration": runs.configuration, "seed": runs.seed, "final_return": final}
        policies = {f"actor/{name}": np.asarray(x) for name, x in arrays_of(actors).items()}
        write_arrays(self._parts / f"policies-{runs.name}.npz", _ends(facts | policies))
        curves = record.curves()
        part = {
            "configuration": runs.configuration.astype(np.int32),
            "seed": runs.seed.astype(np.int32),
            "eval_return": curves["eval_return"].astype(np.float32),
            "env_steps": curves["env_steps"].astype(np.int64),
            "nonfinite": record.nonfinite.astype(np.int32),
        }
        write_arrays(self._path(runs.name), part)
        files.append(self._directory / "results.csv", files.csv_text(self._rows(part)).encode())

    def _gather_policies(self) -> None:
        """Writes the folder ``policies`` of a sweep that ended, a run's directory in each."""
        shutil.rmtree(self._directory / "policies", ignore_errors=True)
        kept = [read_arrays(path) for path in sorted(self._parts.glob("policies-[0-9]*.npz"))]
        configs = configure(self._prepared.design.base, self._configurations)
        for part in self._prepared.parts:
            for number in part.group.members.tolist():
                place, config = self._directory / "policies" / f"{number:03d}", configs[number]
                arrays = _ends(_parts_of(kept, number))
                actors = {k.removeprefix("actor/"): x for k, x in arrays.items() if "/" in k}
                policy = part.ready.policy
                traced = {k: getattr(config, k) for k in part.group.settings if k in policy}
                save_policy(place / "policy", actor_of(actors), policy | traced)
                returns = arrays["final_return"].tolist()
                write_json(place / "summary.json", {"status": "finished", "final_returns": returns})
                run = {"env": config.env, "horizon": part.ready.horizon}
                if config.env_set:
                    run["env_set"] = list(config.env_set)
                write_json(place / "config.json", run | {"seeds": arrays["seed"].tolist()})

    def _path(self, chunk: str) -> Path:
        return self._parts / f"{chunk}.npz"

    def _all(self) -> Arrays:
        """Returns what all chunks measured so far, sorted; empty if nothing."""
        paths = sorted(self._parts.glob("[0-9]*.npz"))
        return join_parts([*map(read_arrays, paths)]) if paths else {}

    def _write_rows(self, rows: Sequence[Sequence[Any]]) -> None:
        """Replaces results.csv at once."""
        text = files.csv_text([self._columns, *rows])
        write_bytes(self._directory / "results.csv", text.encode())

    def _rows(self, part: Arrays) -> list[list[Any]]:
        """Returns the rows of results.csv of a part."""
        returns, env_steps = part["eval_return"], part["env_steps"]
        measured = (  # as in ``_MEASURED``
            part["seed"].tolist(),
            returns[-1].tolist(),
            np.fmax.reduce(returns).tolist(),
            steps_to_solve(returns, env_steps, self.contents["threshold"]),
            env_steps[-1].tolist(),
            part["nonfinite"].tolist(),
        )
        return [
            [number, *map(_spelled, self._configurations[number].values()), *row]
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
