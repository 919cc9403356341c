"""RUN/tensorboard: statistics over seeds, histograms over seeds, and the first seeds, as events.

tensorboardX makes the events. They are written here and not by its ``SummaryWriter``, whose thread
dies on a full disk and then keeps the program from ending.
"""

import importlib
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import append
from mjx_reinforce.runs import over_seeds
from mjx_reinforce.training.rows import Cells

NAME = "tensorboard"
PATTERN = "events.out.tfevents.*"
_BINS = 30


class TensorBoard:
    """Writes events whose step is the number of updates."""

    def __init__(self, directory: Path, updates: int | None):
        """Begins a file of events beside those that are there.

        Args:
          directory: of the run.
          updates: after how many a resumed run goes on: TensorBoard drops what older files have
            of later ones. None drops everything.
        """
        folder = directory / NAME
        folder.mkdir(exist_ok=True)
        # Readers sort the files by name.
        place = f"{int(time.time()):010}.{socket.gethostname()}"
        count = len(list(folder.glob(PATTERN)))
        self._path = folder / f"events.out.tfevents.{place}.{count:04}"
        first = 0 if updates is None else updates + 1
        start = _message("event", "SessionLog")(status="START")
        event, now = _message("event", "Event"), time.time()
        header = event(wall_time=now, file_version="brain.Event:2")
        purge = event(wall_time=now, step=first, session_log=start)
        append(self._path, _record(header) + _record(purge))

    def write(self, rows: Cells) -> None:
        """Adds an event, or raises OSError and adds none."""
        from tensorboardX.summary import make_histogram

        event, summary = _message("event", "Event"), _message("summary", "Summary")
        numbers = over_seeds.scalars(rows).items()
        # Not by ``summary.scalar``, which prints a line for every NaN.
        shown = [summary.Value(tag=name, simple_value=x) for name, x in numbers]
        for name, values in over_seeds.measured(rows).items():
            finite = values[np.isfinite(values)]
            if len(finite) > 1:
                counts = make_histogram(finite, _edges(finite))
                shown.append(summary.Value(tag=f"{name}/seeds", histo=counts))
        step, now = over_seeds.chart_step(rows), time.time()
        append(self._path, _record(event(wall_time=now, step=step, summary=summary(value=shown))))

    def close(self) -> None:
        """Does nothing: every event is written."""


def _message(file: str, name: str) -> Any:
    """Returns a class of tensorboardX's protocol; type checkers do not see what is in its files."""
    return getattr(importlib.import_module(f"tensorboardX.proto.{file}_pb2"), name)


def _edges(values: np.ndarray) -> np.ndarray:
    """Returns the edges of a histogram's bins; they differ even where all values are equal."""
    low, high = values.min(), values.max()
    margin = 1e-6 * max(abs(low), abs(high)) + 1e-12
    return np.linspace(low - margin, high + margin, _BINS + 1)


def _record(event: Any) -> bytes:
    """Returns an event in TensorFlow's record format: length, its checksum, event, checksum."""
    from tensorboardX.record_writer import masked_crc32c

    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    checksums = [struct.pack("<I", masked_crc32c(part)) for part in (length, data)]
    return length + checksums[0] + data + checksums[1]
