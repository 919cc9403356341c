"""What a sink is, which ones a run has, and that of JSON lines."""

import csv
import importlib.util
import json
from pathlib import Path
from typing import Protocol

from mjx_reinforce.files import append, finite, write_bytes
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.rows import Cells, parse_cell

#: Settings that need a package, and the package.
_NEEDED = {"tensorboard": "tensorboardX", "wandb": "wandb"}


class Sink(Protocol):
    """Takes the rows of evaluations, in order."""

    def write(self, rows: Cells) -> None:
        """Adds the rows of one evaluation; raises OSError, and adds nothing, if that fails."""
        ...

    def close(self) -> None:
        """Ends it after the last rows; raises OSError if that fails."""
        ...


class Queue:
    """A sink to which rows that could not be written are written later.

    name: for people
    """

    def __init__(self, name: str, sink: Sink):
        self.name, self._sink = name, sink
        self._waiting: list[Cells] = []

    def write(self, rows: Cells) -> None:
        """Adds the rows of one evaluation after those that wait, or raises OSError."""
        self._waiting.append(rows)
        self._write_waiting()

    def close(self) -> None:
        """Writes the rows that wait, and ends the sink, or raises OSError."""
        self._write_waiting()
        self._sink.close()

    def _write_waiting(self) -> None:
        while self._waiting:
            self._sink.write(self._waiting[0])
            del self._waiting[0]


def check_installed(config: Config) -> None:
    """Raises ValueError for a sink whose package is missing; imports nothing."""
    for name, package in _NEEDED.items():
        spec = importlib.util.find_spec(package)
        # A folder of that name, such as W&B leaves, is found too, but has no origin.
        if getattr(config, name) and (spec is None or spec.origin is None):
            raise ValueError(
                f"--{name} needs the package {package}, which is not installed; "
                f"pip install {package}, or leave --{name} out"
            )


def open_sinks(config: Config, directory: Path, updates: int | None) -> list[Queue]:
    """Opens the sinks that the settings ask for, each where it is to go on.

    Args:
      config: the settings.
      directory: of the run; its metrics.csv has the rows from before.
      updates: after how many a resumed run goes on; None at the first evaluation.

    Raises:
      OSError: one of them cannot be written.
    """
    from mjx_reinforce.runs import charts

    sinks = []
    if config.jsonl:
        sinks.append(Queue("metrics.jsonl", JsonLines(directory)))
    if config.tensorboard:
        sinks.append(Queue("tensorboard/", charts.TensorBoard(directory, updates)))
    if config.wandb:
        sinks.append(Queue("to W&B", charts.WeightsAndBiases(directory)))
    return sinks


def files(directory: Path) -> list[Path]:
    """Returns the files that sinks replace at once."""
    from mjx_reinforce.runs import charts

    return [directory / NAME, directory / charts.WANDB_RUN]


def remove_outputs(directory: Path) -> None:
    """Removes what the sinks of an older run left; W&B keeps its runs apart itself."""
    from mjx_reinforce.runs import charts

    events = (directory / charts.TENSORBOARD).glob(charts.EVENTS)
    for path in (*files(directory), *events):
        path.unlink(missing_ok=True)


NAME = "metrics.jsonl"


class JsonLines:
    """Writes every row as a JSON object on a line.

    A number that is not finite, or was not measured, is null.
    """

    def __init__(self, directory: Path):
        """Writes the rows that metrics.csv has already, in place of what was there."""
        self._path = directory / NAME
        with (directory / "metrics.csv").open(encoding="utf-8", newline="") as file:
            written = [*csv.reader(file)]
        names = written[0]
        columns = zip(*written[1:], strict=True) if written[1:] else ([] for _ in names)
        write_bytes(self._path, _as_json_lines(dict(zip(names, columns, strict=True))))

    def write(self, rows: Cells) -> None:
        """Adds rows, or raises OSError and adds none."""
        append(self._path, _as_json_lines(rows))

    def close(self) -> None:
        """Does nothing: every line is written."""


def _as_json_lines(rows: Cells) -> bytes:
    numbers = zip(*(map(parse_cell, cells) for cells in rows.values()), strict=True)
    objects = (finite(dict(zip(rows, row, strict=True))) for row in numbers)
    return "".join(json.dumps(each, allow_nan=False) + "\n" for each in objects).encode()
