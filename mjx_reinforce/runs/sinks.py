"""Where the rows of evaluations go besides metrics.csv: charts of many seeds.

They show statistics over the seeds, and a few seeds one by one. RUN/tensorboard has events,
written here: on a full disk tensorboardX leaves half of one, behind which nothing is read, and the
thread of its ``SummaryWriter`` dies and keeps the program from ending. RUN/wandb has a run of
Weights & Biases, offline unless WANDB_MODE says otherwise.
"""

import contextlib
import importlib
import os
import secrets
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import Arrays, append, read_json, write_json
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import iqm, iqm_interval

#: Seeds that are shown one by one, the first ones: each is a curve for every column.
MAX_SINGLE_SEEDS = 16
#: Columns that say when an evaluation was; what is shown is their mean.
_PROGRESS_COLUMNS = ("env_steps", "episodes", "wall_seconds")


def chart_step(rows: Arrays) -> int:
    """Returns the place of an evaluation on the axis of charts: the most updates of a seed."""
    return int(rows["update"].max())


def measured(rows: Arrays) -> Arrays:
    """Returns the columns [S] of one evaluation that say nothing of when it was."""
    labels = ("seed", "update", *_PROGRESS_COLUMNS)
    return {name: values.astype(float) for name, values in rows.items() if name not in labels}


def scalars(rows: Arrays) -> dict[str, float]:
    """Returns the numbers that are shown, by name, such as ``eval_return/iqm``.

    For each column: ``iqm``, ``lowest`` (of returns, the worst seed), ``highest``, and ``seed_0``
    and so on, of the first ``MAX_SINGLE_SEEDS``; for the evaluation's return also ``iqm_low`` and
    ``iqm_high``, its 95% interval. A value that is not finite counts as less than any other.

    Args:
      rows: of one evaluation.
    """
    shown_scalars = {f"progress/{name}": float(rows[name].mean()) for name in _PROGRESS_COLUMNS}
    for name, values in measured(rows).items():
        # ``min`` is NaN if any seed's value is, and ``fmax`` passes over those.
        statistics = {"lowest": values.min(), "highest": np.fmax.reduce(values), "iqm": iqm(values)}
        # Of one column alone: an interval takes thousands of resamples.
        if name == "eval_return":
            statistics["iqm_low"], statistics["iqm_high"] = iqm_interval(values)
        statistics |= {f"seed_{seed}": x for seed, x in enumerate(values[:MAX_SINGLE_SEEDS])}
        shown_scalars |= {f"{name}/{statistic}": float(x) for statistic, x in statistics.items()}
    return shown_scalars


EVENTS = "events.out.tfevents.*"


class TensorBoard:
    """Writes events whose step is the number of updates."""

    name = "tensorboard/"

    def __init__(self, directory: Path, updates: int | None):
        """Begins a file of events beside those that are there.

        Args:
          directory: of the run.
          updates: of the last evaluation that a resumed run keeps: TensorBoard drops what older
            files have of later ones. None drops everything.
        """
        folder = directory / "tensorboard"
        folder.mkdir(exist_ok=True)
        # Readers sort the files by name.
        suffix = f"{int(time.time()):010}.{socket.gethostname()}.{len([*folder.glob(EVENTS)]):04}"
        self._path = folder / f"events.out.tfevents.{suffix}"
        self._path.touch()
        self._add(file_version="brain.Event:2")
        # A START makes TensorBoard drop what it has from this step on.
        next_step = 0 if updates is None else updates + 1
        self._add(step=next_step, session_log={"status": "START"})

    def write(self, rows: Arrays) -> None:
        """Adds an event, or raises OSError and adds none."""
        # Not by ``summary.scalar``, which prints a line for every NaN.
        tagged_values = [{"tag": name, "simple_value": x} for name, x in scalars(rows).items()]
        self._add(step=chart_step(rows), summary={"value": tagged_values})

    def close(self) -> None:
        """Does nothing: every event is written."""

    def _add(self, **fields: Any) -> None:
        """Adds an event in TensorFlow's record format: length, its checksum, event, checksum."""
        from tensorboardX.record_writer import masked_crc32c

        proto: Any = importlib.import_module("tensorboardX.proto.event_pb2")
        event = proto.Event(wall_time=time.time(), **fields).SerializeToString()
        length_bytes = struct.pack("<Q", len(event))
        # In one write, which ``append`` takes back if the disk is full: behind half an event
        # nothing would be read.
        checked_parts = (x + struct.pack("<I", masked_crc32c(x)) for x in (length_bytes, event))
        append(self._path, b"".join(checked_parts))


#: Has the id of the run.
WANDB_RUN = "wandb/mjx_reinforce.json"


class WeightsAndBiases:
    """Logs to a run of W&B; the step is the number of updates, and a resumed run has the same id.

    W&B drops rows of steps that the run has already.
    """

    name = "to W&B"

    def __init__(self, directory: Path, updates: int | None):
        """Begins the run in a directory of ours, or goes on with it; raises OSError."""
        del updates  # W&B itself drops what it has
        import wandb

        run_id_path = directory / WANDB_RUN
        mode = os.environ.get("WANDB_MODE", "offline")
        # Without this folder W&B writes elsewhere.
        run_id_path.parent.mkdir(exist_ok=True)
        # The id is drawn here, and not by W&B, so that a resumed run finds it in the file.
        if not run_id_path.exists():
            write_json(run_id_path, {"id": secrets.token_hex(4)})
        with _errors_as_os_errors():
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "mjx_reinforce"),
                name=os.environ.get("WANDB_NAME", directory.resolve().name),
                id=read_json(run_id_path)["id"],
                resume="allow",
                config=read_json(directory / "config.json"),
                dir=directory,
                mode=mode,  # pyright: ignore[reportArgumentType]
                settings=wandb.Settings(silent=True, console="off", x_disable_stats=True),
            )

    def write(self, rows: Arrays) -> None:
        """Logs the rows of one evaluation, or raises OSError."""
        with _errors_as_os_errors():
            self._run.log(scalars(rows), step=chart_step(rows))

    def close(self) -> None:
        """Ends the run, once all of it is written or sent."""
        with _errors_as_os_errors():
            self._run.finish()


@contextlib.contextmanager
def _errors_as_os_errors() -> Iterator[None]:
    """Raises W&B's own errors as OSError: a run warns of an OSError and continues."""
    import wandb

    try:
        yield
    except wandb.Error as error:
        remedy = "run wandb login, or unset WANDB_MODE and send the run later by wandb sync"
        raise OSError(f"{str(error).rstrip('.')}; {remedy}") from error


#: Takes the rows of evaluations, in order; metrics.csv has those that could not be written.
Sink = TensorBoard | WeightsAndBiases
_SINKS: dict[str, type[Sink]] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}


def open_sinks(config: Config, directory: Path, updates: int | None) -> list[Sink]:
    """Opens the sinks that the settings ask for, each where it is to go on.

    Args:
      config: the settings.
      directory: of the run; its metrics.csv has the rows from before.
      updates: of the last evaluation that a resumed run keeps; None at the first evaluation.

    Raises:
      OSError: one of them cannot be written.
    """
    return [_SINKS[name](directory, updates) for name in config.log]
