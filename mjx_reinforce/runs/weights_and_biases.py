"""RUN/wandb: a run of Weights & Biases, offline unless WANDB_MODE says otherwise."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjx_reinforce.files import read_json, write_json
from mjx_reinforce.runs import over_seeds
from mjx_reinforce.training.rows import Cells

#: Which run it is, and up to which update it has rows.
NAME = "wandb/mjx_reinforce.json"
_TO_BE_ONLINE = "; run wandb login, or unset WANDB_MODE and send the run later by wandb sync"


class WeightsAndBiases:
    """Logs the statistics over seeds, and the first seeds; the step is the number of updates.

    A resumed run goes on under the same id. Rows that it has already are not logged again: they
    are the same.
    """

    def __init__(self, directory: Path):
        """Begins the run, or goes on with it.

        Args:
          directory: of ours.

        Raises:
          OSError: W&B cannot be started.
        """
        import wandb

        self._path = directory / NAME
        self._path.parent.mkdir(exist_ok=True)  # without it W&B writes elsewhere
        known = read_json(self._path) if self._path.exists() else {}
        self._logged = int(known.get("updates", -1))
        mode: Any = os.environ.get("WANDB_MODE", "offline")
        with _errors_as_os_errors(_TO_BE_ONLINE if mode == "online" else ""):
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "mjx_reinforce"),
                name=os.environ.get("WANDB_NAME", directory.resolve().name),
                id=known.get("id"),
                resume="allow" if known and mode == "online" else None,
                config=read_json(directory / "config.json"),
                dir=directory,
                mode=mode,
                settings=wandb.Settings(silent=True, console="off", x_disable_stats=True),
            )
        self._save()

    def write(self, rows: Cells) -> None:
        """Logs the rows of one evaluation, or raises OSError."""
        step = over_seeds.chart_step(rows)
        if step <= self._logged:
            return
        with _errors_as_os_errors():
            self._run.log(over_seeds.scalars(rows), step=step)
        self._logged = step
        self._save()

    def close(self) -> None:
        """Ends the run, once all of it is written or sent."""
        with _errors_as_os_errors():
            self._run.finish()

    def _save(self) -> None:
        write_json(self._path, {"id": self._run.id, "updates": self._logged})


@contextlib.contextmanager
def _errors_as_os_errors(remedy: str = "") -> Iterator[None]:
    """Raises W&B's own errors as OSError: a run warns of an OSError and continues."""
    import wandb

    try:
        yield
    except wandb.Error as error:
        raise OSError(str(error).rstrip(".") + remedy) from error
