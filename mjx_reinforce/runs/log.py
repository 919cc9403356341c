"""The files of a run: config.json first, metrics.csv as it goes on, the rest at its end."""

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.files import write_arrays, write_bytes, write_json
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.runs import sinks
from mjx_reinforce.store.provenance import provenance
from mjx_reinforce.training import checkpoint, rows
from mjx_reinforce.training.checkpoint import Checkpoint

#: The files of a run, besides those in ``checkpoint/``.
_POLICY = ("policy/actor.npz", "policy/policy.json")
_BEST = ("policy/best/actor.npz", "policy/best/policy.json")
_RESULTS = ("summary.json", "learning_curve.png", "returns.npz", *_POLICY, *_BEST)
_FILES = ("config.json", "metrics.csv", *_RESULTS)


class RunLog:
    """Writes the files of a run into its directory; each raises OSError where that fails."""

    def __init__(self, directory: Path):
        self.directory = directory
        self._metrics = directory / "metrics.csv"
        #: Rows that could not be written yet.
        self._waiting = b""

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet; removes an older run.

        Args:
          settings: of the run; what else its results depend on is added.
        """
        self._remove_parts()
        for name in _RESULTS:
            (self.directory / name).unlink(missing_ok=True)
        checkpoint.remove_checkpoints(self.directory / "checkpoint")
        sinks.remove_outputs(self.directory)
        write_json(self.directory / "config.json", {**settings, **provenance()})
        files.create_csv(self._metrics, rows.COLUMNS)

    def resume(
        self, recorded: dict[str, Any], budget: Mapping[str, Any], found: Checkpoint | None
    ) -> None:
        """Takes the files back to a checkpoint, and says in config.json that the run goes on.

        A crash in between leaves a run that can be resumed: config.json is first, so that the
        budget in it chooses the same checkpoint.

        Args:
          recorded: what config.json says.
          budget: settings that may have changed.
          found: the checkpoint, or None to start again.
        """
        self._remove_parts()
        moment = {
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "updates": 0 if found is None else int(found.record["updates"].max()),
            "env_steps": 0 if found is None else int(found.record["env_steps"].sum()),
        }
        resumed = [*recorded.get("resumed", []), moment]
        write_json(self.directory / "config.json", {**recorded, **budget, "resumed": resumed})
        self.say_running(moment)
        checkpoint.remove_checkpoints(
            self.directory / "checkpoint", after=found.number if found else 0
        )
        if found is None:
            files.create_csv(self._metrics, rows.COLUMNS)
        else:
            files.cut(self._metrics, found.metrics_bytes)

    def _remove_parts(self) -> None:
        """Removes what a crash left of writing files."""
        for path in (*(self.directory / name for name in _FILES), *sinks.files(self.directory)):
            for part in path.parent.glob(f".{path.name}.*"):
                part.unlink()

    def say_running(self, reached: Mapping[str, Any]) -> None:
        """Writes a summary.json that says how far the run is, in case the run is killed."""
        write_json(self.directory / "summary.json", {"status": "running", **reached})

    def add_rows(self, new: rows.Cells) -> None:
        """Appends rows to metrics.csv, after those that could not be written before."""
        self._waiting += rows.lines(new)
        self._write_waiting()

    def _write_waiting(self) -> None:
        files.append(self._metrics, self._waiting)
        self._waiting = b""

    def metrics_bytes(self) -> int:
        """Returns the length of metrics.csv with all rows in it."""
        self._write_waiting()
        return self._metrics.stat().st_size

    def save_policies(self, last: Actor, best: Actor, settings: dict[str, Any]) -> None:
        """Writes the folders ``policy`` and ``policy/best``, see ``policy_files.save_policy``."""
        save_policy(self.directory / "policy", last, settings)
        save_policy(self.directory / "policy" / "best", best, settings)

    def save_checkpoint(self, content: Checkpoint, *, even: bool) -> None:
        """Writes a checkpoint, see ``checkpoint.save``."""
        checkpoint.save(self.directory / "checkpoint", content, even=even)

    def finish(
        self, training: dict[str, np.ndarray], picture: bytes, summary: Mapping[str, Any]
    ) -> None:
        """Writes the last rows, returns.npz, learning_curve.png and, last of all, summary.json.

        Args:
          training: the arrays of returns.npz.
          picture: the contents of learning_curve.png.
          summary: the contents of summary.json.
        """
        self._write_waiting()
        write_arrays(self.directory / "returns.npz", training, compressed=True)
        write_bytes(self.directory / "learning_curve.png", picture)
        write_json(self.directory / "summary.json", summary)
