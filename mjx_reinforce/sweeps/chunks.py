"""Chunks: as many runs of a group as are under way at once."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from mjx_reinforce.runs import checkpoint
from mjx_reinforce.runs.checkpoint import Checkpoint
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.record import Record
from mjx_reinforce.runs.state import RunState
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

    Seeds come before configurations, so that every chunk has its share of each configuration and
    all take about as long.

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


def begin(programs: Programs, group: Group, runs: Runs) -> RunState:
    """Returns the states of the runs of a chunk before their first update."""
    settings = {name: values[runs.place] for name, values in group.settings.items()}
    return programs.begin(programs.keys[runs.seed], settings)


class Saver:
    """Keeps a chunk in progress in checkpoints, and finds it again."""

    def __init__(self, folder: Path, config: Config):
        """Takes the folder of the chunk's checkpoints, and the settings of its group."""
        self._folder, self._config = folder, config
        self._saved_at, self._saved_updates = time.perf_counter(), 0

    def save_if_due(self, states: RunState, record: Record) -> None:
        """Saves once there were enough updates, or about a minute, since the last time."""
        every, updates = self._config.checkpoint_every, int(record.updates.max())
        if every is None:
            due = time.perf_counter() - self._saved_at >= _CHECKPOINT_SECONDS
        else:
            due = updates - self._saved_updates >= every
        if due:
            self.save(states, record)

    def save(self, states: RunState, record: Record) -> None:
        """Writes a checkpoint, or raises OSError."""
        content = Checkpoint(
            state=states,
            record=record.arrays(),
            seconds=record.seconds,
            metrics_bytes=0,
            env_steps=self._config.env_steps,
            max_updates=self._config.max_updates,
        )
        checkpoint.save(self._folder, content, even=False)
        self._saved_at, self._saved_updates = time.perf_counter(), int(record.updates.max())

    def find(
        self, like: Callable[[], RunState], record: Record, say: Callable[[str], None]
    ) -> RunState | None:
        """Returns the newest state that was saved, with its record restored, or None."""
        if not self._folder.exists():
            return None
        for found in checkpoint.load(self._folder, like(), say):
            record.restore(found.record)
            return jax.device_get(found.state)
        return None

    def remove(self) -> None:
        """Removes the checkpoints."""
        checkpoint.remove(self._folder)


def train(
    programs: Programs,
    states: RunState,
    record: Record,
    after: Callable[[RunState, Record], bool],
) -> RunState | None:
    """Trains a chunk to its budget.

    Args:
      programs: of its group.
      states: of its runs, before the first update or from a checkpoint.
      record: of its runs.
      after: is called after every evaluation; where it returns False the chunk is left.

    Returns:
      The last states, or None where the chunk was left.
    """
    began = time.perf_counter() - record.seconds
    if not record.evaluated():
        record.keep_evaluation(programs.evaluate(states), time.perf_counter() - began)
    while not record.finished():
        last = record.last_evaluation()
        states, metrics, evaluation, moved = programs.advance(states, last["eval_steps"])
        record.keep_updates(metrics)
        # A run that stood still was not played again.
        evaluation = {name: np.where(moved, x, last[name]) for name, x in evaluation.items()}
        record.keep_evaluation(evaluation, time.perf_counter() - began)
        if not after(states, record):
            return None
    return states
