"""Chunks: as many runs of a group as are under way at once."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.history import History, Measured
from mjx_reinforce.sweeps.layout import StateRows
from mjx_reinforce.sweeps.plan import Group
from mjx_reinforce.sweeps.programs import SlotPrograms
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.checkpoint import Attempts, Checkpoint, SaveDue
from mjx_reinforce.training.state import RunState

#: The host need not look at a sweep more often than this. Between short blocks the devices would
#: wait for it.
_SECONDS = 0.25


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


def split_runs(group: Group, name: str, num_chunks: int) -> list[Runs]:
    """Returns the runs of a group in chunks, all of one size except the last.

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
    seed += group.config.first_seed
    return [
        Runs(f"{name}-{i:04d}", place[part], group.members[place[part]], seed[part])
        for i, part in enumerate(runs[start : start + size] for start in range(0, total, size))
    ]


def initial_states(programs: SlotPrograms, group: Group, runs: Runs) -> np.ndarray:
    """Returns the states [R, B] of the runs of a chunk before their first update."""
    settings = {name: values[runs.place] for name, values in group.settings.items()}
    return programs.begin(runs.seed, settings)


class Saver:
    """Keeps a chunk in progress in checkpoints, and finds it again."""

    def __init__(self, folder: Path, config: Config, layout: StateRows, say: Callable[[str], None]):
        """Takes what a chunk is kept in.

        Args:
          folder: of the chunk's checkpoints.
          config: the settings of its group.
          layout: of its group's states.
          say: shows a line to the user.
        """
        self._folder, self._config, self._layout, self._say = folder, config, layout, say
        self._due = SaveDue(config.checkpoint_every)
        self._attempt = Attempts(say).attempt

    def save_if_due(self, states: np.ndarray, history: History) -> None:
        """Saves once there were enough updates, or about a minute, since the last time.

        A checkpoint that cannot be written is a warning, and is tried again when one is due.
        """
        if not self._due.is_due(_updates(history)):
            return
        if not self._attempt("a checkpoint", lambda: self.save(states, history)):
            self._due.saved(_updates(history))

    def save(self, states: np.ndarray, history: History) -> None:
        """Writes a checkpoint, or raises OSError."""
        content = Checkpoint(
            state=self._layout.states(states),
            record=history.arrays(),
            seconds=history.seconds,
            metrics_bytes=0,
            env_steps=self._config.env_steps,
            max_updates=self._config.max_updates,
        )
        checkpoint.save(self._folder, content, even=False)
        self._due.saved(_updates(history))

    def find(self, like: RunState, history: History) -> np.ndarray | None:
        """Returns the newest states that were saved, with their history restored, or None.

        ``like`` has the shapes of the states.
        """
        for found in checkpoint.read_checkpoints(self._folder, like, self._say):
            history.restore(found.record)
            self._due.saved(_updates(history))
            return self._layout.rows(found.state)
        return None

    def remove(self) -> None:
        """Removes the checkpoints."""
        checkpoint.remove_checkpoints(self._folder)


def _updates(history: History) -> int:
    """Returns how many updates the run with the most has made."""
    return int(history.now["updates"].max())


class Chunk:
    """A chunk as it goes on, for ``training.driver.drive``."""

    def __init__(
        self,
        programs: SlotPrograms,
        states: np.ndarray,
        history: History,
        observers: Sequence[Callable[[], None]],
        most: int,
    ):
        """Takes what a chunk is made of.

        Args:
          programs: of its group.
          states: [R, B] of its runs, before the first update or from a checkpoint; changed.
          history: of its runs; changed.
          observers: are called after every evaluation, or where these take milliseconds after
            several.
          most: evaluations between two calls at most.
        """
        self._programs, self._states, self._history = programs, states, history
        self._observers, self._most = observers, most
        self._began = time.perf_counter() - history.seconds
        self._blocks = 1

    def over(self) -> bool:
        """Returns whether all runs used their budgets; then evaluates the last policies."""
        if self._history.training().any():
            return False
        if not self._history.evaluated():
            self._keep([self._programs.evaluate(self._states)])
        return True

    def advance(self) -> None:
        """Evaluates the runs that still train and makes a block of updates, or several blocks."""
        history, last = self._history, self._history.seconds
        lengths = history.now["eval_steps"]
        measured = self._programs.advance(self._states, history.training(), lengths, self._blocks)
        assert measured, "runs that have not used their budgets made no update"
        self._keep(measured)
        enough = len(measured) * _SECONDS / (history.seconds - last)
        self._blocks = max(1, min(int(enough), 2 * len(measured), self._most))
        for observer in self._observers:
            observer()

    def _keep(self, measured: Sequence[Measured]) -> None:
        self._history.keep(measured, time.perf_counter() - self._began)
