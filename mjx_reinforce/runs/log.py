"""The files of a run: config.json first, metrics.csv as it goes on, the rest at its end."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.export.files import write_arrays, write_bytes, write_json
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.runs import files, rows


@dataclasses.dataclass(frozen=True)
class RunLog:
    """Writes the files of a run into its directory."""

    directory: Path

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet.

        Args:
          settings: of the run; what else its results depend on is added.
        """
        write_json(self.directory / "config.json", {**settings, **files.provenance()})
        files.create_csv(self.directory / "metrics.csv", rows.COLUMNS)

    def add_rows(self, new: Sequence[Mapping[str, Any]]) -> None:
        """Appends the rows of an evaluation to metrics.csv."""
        files.append_csv(self.directory / "metrics.csv", rows.COLUMNS, new)

    def save_policy(self, actor: Actor, settings: dict[str, Any]) -> None:
        """Writes the folder ``policy``, see ``policy_files.save_policy``."""
        save_policy(self.directory / "policy", actor, settings)

    def finish(
        self, training: dict[str, np.ndarray], picture: bytes, summary: Mapping[str, Any]
    ) -> None:
        """Writes returns.npz, learning_curve.png and, last of all, summary.json.

        Args:
          training: the arrays of returns.npz.
          picture: the contents of learning_curve.png.
          summary: the contents of summary.json.
        """
        write_arrays(self.directory / "returns.npz", training, compressed=True)
        write_bytes(self.directory / "learning_curve.png", picture)
        write_json(self.directory / "summary.json", summary)
