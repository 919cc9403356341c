"""Chunks: as many runs of a group as are trained side by side."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_reinforce.runs import checkpoint
from mjx_reinforce.runs.checkpoint import Checkpoint
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.record import Record
from mjx_reinforce.runs.state import RunState, seed_keys
from mjx_reinforce.sweeps.devices import RUNS, Devices
from mjx_reinforce.sweeps.groups import Group
from mjx_reinforce.sweeps.programs import Programs

#: Between checkpoints, where the user has not said how many updates.
_CHECKPOINT_SECONDS = 60.0


class Runs(NamedTuple):
    """The runs of a chunk.

    name: of the chunk, for its files
    place: [R] the configuration of each run, counted within its group
    configuration: [R] the same, counted in the sweep
    seed: [R]
    """

    name: str
    place: np.ndarray
    configuration: np.ndarray
    seed: np.ndarray


def split(group: Group, name: str, num_chunks: int) -> list[Runs]:
    """Returns the runs of a group in chunks, all of one size but for the last.

    Seeds come before configurations, so that every chunk, and every device, has its share of each
    configuration and all take about as long.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      name: of the group, for the files.
      num_chunks: how many.
    """
    total = len(group.members) * group.config.num_seeds
    size = -(-total // num_chunks)
    runs = np.arange(total)
    seed, place = np.divmod(runs, len(group.members))
    return [
        Runs(f"{name}-{i:04d}", place[part], group.members[place[part]], seed[part])
        for i, part in enumerate(runs[start : start + size] for start in range(0, total, size))
    ]


def begin(
    programs: Programs, devices: Devices, group: Group, runs: Runs, slots: int
) -> list[RunState]:
    """Returns a chunk before its first update, filled up with runs that stand still."""
    size = slots * programs.width
    keys = seed_keys(group.config)
    padding = np.arange(size) >= len(runs.seed)
    seed, place = (np.resize(x, size) for x in (runs.seed, runs.place))
    chunk = []
    for start in range(0, size, programs.width):
        part = slice(start, start + programs.width)
        settings = {
            name: np.asarray(values[place[part]], np.result_type(programs.like.settings[name]))
            for name, values in group.settings.items()
        }
        chunk.append(
            programs.begin(*devices.put((keys[seed[part]], settings, padding[part]), RUNS))
        )
    return chunk


class Saver:
    """Keeps a chunk in progress in checkpoints, and finds it again."""

    def __init__(self, folder: Path, config: Config):
        """Takes the folder of the chunk's checkpoints, and the settings of its group."""
        self._folder, self._config = folder, config
        self._saved_at, self._saved_updates = time.perf_counter(), 0

    def save_if_due(self, chunk: list[RunState], record: Record) -> None:
        """Saves once there were enough updates, or about a minute, since the last time."""
        every, updates = self._config.checkpoint_every, int(record.updates.max())
        if every is None:
            due = time.perf_counter() - self._saved_at >= _CHECKPOINT_SECONDS
        else:
            due = updates - self._saved_updates >= every
        if due:
            self.save(chunk, record)

    def save(self, chunk: list[RunState], record: Record) -> None:
        """Writes a checkpoint, or raises OSError."""
        content = Checkpoint(
            state=chunk,
            record=record.arrays(),
            seconds=record.seconds,
            metrics_bytes=0,
            env_steps=self._config.env_steps,
            max_updates=self._config.max_updates,
        )
        checkpoint.save(self._folder, content, even=False)
        self._saved_at, self._saved_updates = time.perf_counter(), int(record.updates.max())

    def find(
        self, like: list[RunState], record: Record, say: Callable[[str], None]
    ) -> list[RunState] | None:
        """Returns the newest state that was saved, with its record restored, or None."""
        for found in checkpoint.load(self._folder, like, say):
            record.restore(found.record)
            return found.state
        return None

    def remove(self) -> None:
        """Removes the checkpoints."""
        checkpoint.remove(self._folder)


def train(
    programs: Programs,
    chunk: list[RunState],
    record: Record,
    num_runs: int,
    after: Callable[[list[RunState], Record], bool],
) -> list[RunState] | None:
    """Trains a chunk to its budget.

    Args:
      programs: of its group.
      chunk: its states, before the first update or from a checkpoint.
      record: of its runs, which are the first ``num_runs`` of the states.
      num_runs: R.
      after: is called after every evaluation; where it returns False the chunk is left.

    Returns:
      The last states, or None where the chunk was left.
    """

    def cut(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: x[..., :num_runs] for name, x in arrays.items()}

    began = time.perf_counter() - record.seconds
    if not record.evaluated():
        record.keep_evaluation(cut(programs.evaluate(chunk)), time.perf_counter() - began)
    while not record.finished():
        chunk, metrics, evaluation = programs.advance(chunk)
        metrics, evaluation = cut(metrics), cut(evaluation)
        record.add_updates(metrics)
        # A run that stood still was not played again.
        moved, last = metrics["active"].any(axis=0), record.last_evaluation()
        evaluation = {name: np.where(moved, x, last[name]) for name, x in evaluation.items()}
        record.keep_evaluation(evaluation, time.perf_counter() - began)
        if not after(chunk, record):
            return None
    return chunk
