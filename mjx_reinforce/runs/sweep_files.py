"""The files of a sweep: DIR/sweep.json, curves.npz, policies/, and the parts of them so far.

A part is what one chunk of runs measured and learned. It is written whole, when the chunk ends, and
is all that the other files are made of: all else that a crash leaves is written again.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.console.commands import typed
from mjx_reinforce.export.policy_files import actor_of, arrays_of, save_policy
from mjx_reinforce.files import Arrays, read_arrays, remove_parts, write_arrays, write_json
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs.design import as_record, configure
from mjx_reinforce.runs.plan import Part, Prepared
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.settings.config import Config
from mjx_reinforce.store.provenance import provenance
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.driver import Training
from mjx_reinforce.training.record import ChunkRecord

#: The arrays of curves.npz, and their types.
_CURVES = {
    "configuration": np.int32,
    "seed": np.int32,
    "eval_return": np.float32,
    "env_steps": np.int64,
    "nonfinite": np.int32,
}


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
        """Begins, with sweep.json first: where that cannot be written, nothing was begun."""
        self._write_json("sweep.json", self.contents)
        super().open()
        self._parts.mkdir(exist_ok=True)
        remove_parts(*self._parts.glob("*/"))  # of checkpoints

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of a chunk have ended."""
        return self._path(chunk).exists()

    def began(self, driver: Training) -> None:
        """Takes a chunk to its newest checkpoint, if there is one."""
        found = checkpoint.read_checkpoints(self._folder(driver), self._say)
        self._go_on(driver, next(found, None))

    def ended(self, driver: Training) -> None:
        """Writes the part of a chunk, or a checkpoint of one that was interrupted."""
        if not driver.record.done():
            super().ended(driver)
            return
        self._write_part(driver)
        checkpoint.remove_checkpoints(self._folder(driver))

    def finished(self, driver: Training, summary: dict[str, Any]) -> None:
        """Joins the parts so far, sorted; those of a sweep that ended go after sweep.json."""
        parts = {path.stem: read_arrays(path) for path in sorted(self._parts.glob("*.npz"))}
        if parts:
            curves = join_parts([{name: part[name] for name in _CURVES} for part in parts.values()])
            write_arrays(self._directory / "curves.npz", curves, compressed=True)
        if summary["status"] == "finished":
            shutil.rmtree(self._directory / "policies", ignore_errors=True)
            configs = configure(self._prepared.design.base, self._configurations)
            for part in self._prepared.parts:
                self._write_policies(part, [parts[runs.name] for runs in part.chunks], configs)
        self._write_json("sweep.json", summary)
        if summary["status"] == "finished":
            shutil.rmtree(self._parts)

    def _save_checkpoint(self, driver: Training) -> None:
        checkpoint.save(self._folder(driver), driver.checkpoint(), even=False)

    def _folder(self, driver: Training) -> Path:
        """Returns the folder of a chunk's checkpoints."""
        assert isinstance(driver.record, ChunkRecord)
        return self._parts / driver.record.runs.name

    def _path(self, chunk: str) -> Path:
        return self._parts / f"{chunk}.npz"

    def _write_part(self, driver: Training) -> None:
        """Writes what a chunk measured, and the last policies of each configuration's ends."""
        record = driver.record
        assert isinstance(record, ChunkRecord)
        runs, actors = record.runs, arrays_of(driver.slots.states().train_states.actor)
        found = record.curves() | runs._asdict() | {"nonfinite": record.nonfinite}
        curves = {name: found[name].astype(kind) for name, kind in _CURVES.items()}
        configurations = np.unique(curves["configuration"])
        kept = np.concatenate([_ends(curves, number) for number in configurations])
        policies = {f"actor/{name}": np.asarray(x)[kept] for name, x in actors.items()}
        write_arrays(self._path(runs.name), curves | policies | {"kept": kept})

    def _write_policies(
        self, part: Part, chunks: Sequence[Arrays], configs: Sequence[Config]
    ) -> None:
        """Writes the policies of the worst and the best seed of each configuration of a group.

        Each folder is as the directory of a run.

        Args:
          part: the group.
          chunks: what its parts have.
          configs: the settings of all configurations.
        """
        names = [name for name in chunks[0] if "/" in name]
        every = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}
        for name in ("configuration", "seed", "eval_return"):
            ends = [chunk[name][..., chunk["kept"]] for chunk in chunks]
            every[name] = np.concatenate([x[-1:] if x.ndim > 1 else x for x in ends], axis=-1)
        for number in part.group.members.tolist():
            kept = _ends(every, number)
            actors = {name.removeprefix("actor/"): every[name][kept] for name in names}
            place, config = self._directory / "policies" / f"{number:03d}", configs[number]
            policy = part.ready.policy
            traced = {k: getattr(config, k) for k in part.group.settings if k in policy}
            save_policy(place / "policy", actor_of(actors), policy | traced)
            final = every["eval_return"][-1, kept].astype(np.float64)
            ranked = {"status": "finished", "final_returns": final.tolist()}
            write_json(place / "summary.json", ranked)
            run = {"env": config.env, "horizon": part.ready.horizon}
            if config.env_set:
                run["env_set"] = list(config.env_set)
            write_json(place / "config.json", run | {"seeds": every["seed"][kept].tolist()})


def _ends(curves: Arrays, number: int) -> np.ndarray:
    """Returns which runs are the worst and the best seed of a configuration, or which is both."""
    runs = np.flatnonzero(curves["configuration"] == number)
    runs = runs[np.argsort(curves["seed"][runs])]
    values = np.nan_to_num(curves["eval_return"][-1, runs], nan=-np.inf)
    return runs[sorted({int(values.argmin()), int(values.argmax())})]


def join_parts(parts: Sequence[Mapping[str, np.ndarray]]) -> Arrays:
    """Returns several parts as one, sorted by configuration and seed.

    A run whose evaluations ended earlier repeats its last.
    """
    length = max(len(part["eval_return"]) for part in parts)

    def joined(name: str) -> np.ndarray:
        each = [part[name] for part in parts]
        return np.concatenate([lengthened(x, length) if x.ndim > 1 else x for x in each], axis=-1)

    order = np.lexsort((joined("seed"), joined("configuration")))
    return {name: joined(name)[..., order] for name in parts[0]}
