"""Chunks: as many runs of a group as are under way at once, and what they have measured."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.sweeps.plan import Group
from mjx_reinforce.sweeps.programs import Measured, SlotPrograms
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.checkpoint import Attempts, Checkpoint, SaveDue
from mjx_reinforce.training.progress import Progress, measure_progress, used
from mjx_reinforce.training.record import GrowingTable

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


#: What is kept of every evaluation, and the name of its latest.
_CURVES = {"eval_return": "eval_return", "env_steps": "eval_env_steps"}


class History:
    """What each of R runs has measured.

    now: [R] each, the latest of what ``Measured`` has; ``nonfinite`` since the start, and
      ``eval_env_steps``, the env steps before the latest evaluation
    seconds: wall time from the beginning to the last block
    """

    def __init__(self, config: Config):
        """Begins before the first update; R is ``config.num_seeds``."""
        self._config = config
        counts = ("updates", "env_steps", "nonfinite", "eval_steps", "eval_env_steps")
        self.now: Arrays = {name: np.zeros(config.num_seeds, np.int64) for name in counts}
        self.now["eval_return"] = np.zeros(config.num_seeds, np.float32)
        self.seconds = 0.0
        self._curves = GrowingTable({})
        self._before = self.now["env_steps"], self.seconds

    def keep(self, blocks: Sequence[Measured], seconds: float) -> None:
        """Takes in evaluations and the blocks of updates after them.

        Args:
          blocks: one after the other; runs that are not in them stay as they are.
          seconds: wall time since the beginning.
        """
        now = self.now
        self._before, self.seconds = (now["env_steps"].copy(), self.seconds), seconds
        for runs, values in blocks:
            now["eval_env_steps"][runs] = now["env_steps"][runs]
            for name, measured in values.items():
                now[name][runs] = measured + (now[name][runs] if name == "nonfinite" else 0)
            self._curves.append({name: now[own][None].copy() for name, own in _CURVES.items()})

    def arrays(self) -> Arrays:
        """Returns all that was measured, by name, for ``restore``."""
        curves = {f"curves.{name}": x for name, x in self._curves.columns().items()}
        return {"seconds": np.asarray(self.seconds, np.float64), **self.now, **curves}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Goes back to what a history of the same runs had measured.

        Args:
          arrays: from its ``arrays``.
        """
        self.now = {name: arrays[name] for name in self.now}
        self.seconds = float(arrays["seconds"])
        self._before = self.now["env_steps"], self.seconds
        curves = {f"curves.{name}": name for name in _CURVES}  # none before the first evaluation
        known = {name: arrays[key] for key, name in curves.items() if key in arrays}
        self._curves = GrowingTable(known)

    def evaluated(self) -> bool:
        """Returns whether the present policies of all runs have been evaluated."""
        same = np.array_equal(self.now["eval_env_steps"], self.now["env_steps"])
        return same and bool(self._curves.latest(1))

    def curves(self) -> Arrays:
        """Returns ``eval_return``, and ``env_steps`` until then, [E, R] each."""
        return self._curves.columns()

    def training(self) -> np.ndarray:
        """Returns which runs [R] have not used their budget."""
        return self._used() < 1.0

    def used(self) -> float:
        """Returns the part of the budgets of all runs that is used."""
        return float(np.minimum(self._used(), 1.0).mean())

    def _used(self) -> np.ndarray:
        """Returns the fraction of its budget that each run has used."""
        return used(self._config, self.now["env_steps"], self.now["updates"])

    def progress(self) -> Progress:
        """Returns how far the runs are; its fraction is that of all budgets, as ``used``."""
        steps, seconds = self._before
        past = {
            "eval_return": self.now["eval_return"][None],
            "env_steps": np.stack([steps, self.now["env_steps"]]),
            "updates": self.now["updates"][None],
            "seconds": np.array([seconds, self.seconds]),
        }
        return measure_progress(past, np.array([self.used()] * 2))


class Chunk:
    """The runs of a chunk as they go on, for ``training.driver.drive``, and its checkpoints.

    history: what they have measured
    """

    def __init__(
        self,
        programs: SlotPrograms,
        group: Group,
        runs: Runs,
        folder: Path,
        say: Callable[[str], None],
        show: Callable[[History], None],
    ):
        """Begins, or goes on from the newest checkpoint that is there.

        Args:
          programs: of the group.
          group: of which the runs are.
          runs: the chunk's.
          folder: of its checkpoints.
          say: shows a line to the user.
          show: shows how far the chunk is, after each block of updates.
        """
        config = dataclasses.replace(group.config, num_seeds=len(runs.seed))
        self._programs, self._config, self._folder = programs, config, folder
        self._show, self._attempt = show, Attempts(say).attempt
        self._due, self.history = SaveDue(config.checkpoint_every), History(config)
        like = programs.layout.shapes(len(runs.seed))
        found = next(checkpoint.read_checkpoints(folder, like, say), None)
        if found is None:
            settings = {name: values[runs.place] for name, values in group.settings.items()}
            self._states = programs.begin(runs.seed, settings)
        else:
            self._states = programs.layout.rows(found.state)
            self.history.restore(found.record)
            self._due.saved(self._updates())
        self._began = time.perf_counter() - self.history.seconds
        #: How many blocks are made before the host looks at the runs again.
        self._blocks = 1

    def over(self) -> bool:
        """Returns whether all runs used their budgets; then evaluates the last policies."""
        if self.history.training().any():
            return False
        if not self.history.evaluated():
            self._keep([self._programs.evaluate(self._states)])
        return True

    def advance(self) -> None:
        """Evaluates the runs that still train and makes a block of updates, or several blocks.

        A checkpoint that is due then and cannot be written is a warning; it is tried again when
        the next one is due.
        """
        history, last = self.history, self.history.seconds
        lengths = history.now["eval_steps"]
        measured = self._programs.advance(self._states, history.training(), lengths, self._blocks)
        assert measured, "runs that have not used their budgets made no update"
        self._keep(measured)
        enough = len(measured) * _SECONDS / (history.seconds - last)
        most = (self._config.checkpoint_every or MAX_COUNT) // self._config.eval_every
        self._blocks = max(1, min(int(enough), 2 * len(measured), most))
        self._show(history)
        if self._due.is_due(self._updates()):
            self._attempt("a checkpoint", self.save)
            self._due.saved(self._updates())

    def save(self) -> None:
        """Writes a checkpoint, or raises OSError."""
        content = Checkpoint(
            state=self._programs.layout.states(self._states),
            record=self.history.arrays(),
            seconds=self.history.seconds,
            metrics_bytes=0,
            env_steps=self._config.env_steps,
            max_updates=self._config.max_updates,
        )
        checkpoint.save(self._folder, content, even=False)

    def actors(self) -> Actor:
        """Returns the present policies [R, ...]."""
        return self._programs.layout.states(self._states).train_states.actor

    def _keep(self, measured: Sequence[Measured]) -> None:
        self.history.keep(measured, time.perf_counter() - self._began)

    def _updates(self) -> int:
        """Returns how many updates the run with the most has made."""
        return int(self.history.now["updates"].max())
