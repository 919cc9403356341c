"""Chunks: as many runs of a group as are under way at once, and what they have measured."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.sweeps.plan import Group
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.checkpoint import Attempts, SaveDue
from mjx_reinforce.training.driver import Training, drive
from mjx_reinforce.training.progress import Progress, measure_progress
from mjx_reinforce.training.record import Record
from mjx_reinforce.training.slots import Compiled, Measured, Slots
from mjx_reinforce.training.state import shape_of_all


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


class ChunkRecord(Record):
    """What the R runs of a chunk have measured.

    nonfinite: [R] how many of its updates met numbers that are not finite
    lengths: [R] the steps of all episodes of each run's latest evaluation
    """

    _kept = ("updates", "env_steps", "seconds", "nonfinite", "lengths")

    def __init__(self, config: Config):
        """Begins before the first update; R is ``config.num_seeds``."""
        super().__init__(config)
        self.nonfinite = np.zeros(config.num_seeds, np.int64)
        self.lengths = np.zeros(config.num_seeds, np.int64)
        self._before = self.env_steps, self.seconds

    def add(self, blocks: Sequence[Measured], seconds: float) -> None:
        """Takes in evaluations and the updates after them.

        Args:
          blocks: one after the other; runs that made no update in it stay as they are.
          seconds: wall time since the beginning.
        """
        self._before, self.seconds = (self.env_steps.copy(), self.seconds), seconds
        for runs, metrics, looked in blocks:
            made = np.any(metrics["active"], axis=0) if metrics else np.ones(len(runs), bool)
            self._add_evaluation(runs[made], {name: x[made] for name, x in looked.items()})
            if metrics:
                self._add_updates(runs, metrics)

    def _add_evaluation(self, runs: np.ndarray, looked: Arrays) -> None:
        latest = self.latest()
        latest["eval_return"][runs] = looked["eval_return"]
        latest["env_steps"][runs] = self.env_steps[runs]
        self.lengths[runs] = looked["eval_steps"]
        self._tables["evaluations"].append({name: x[None] for name, x in latest.items()})

    def _add_updates(self, runs: np.ndarray, metrics: Arrays) -> None:
        broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
        self.updates[runs] += metrics["active"].sum(axis=0)
        steps = np.where(metrics["active"], metrics["env_steps"], 0)
        self.env_steps[runs] += steps.sum(axis=0, dtype=np.int64)
        self.nonfinite[runs] += (broken & metrics["active"]).sum(axis=0)

    def latest(self) -> Arrays:
        """Returns ``eval_return`` of each run's latest evaluation, and ``env_steps`` until then."""
        if not self.begun():
            num_runs = len(self.updates)
            return {
                "eval_return": np.zeros(num_runs, np.float32),
                "env_steps": np.zeros(num_runs, np.int64),
            }
        return {name: x[0].copy() for name, x in self._tables["evaluations"].latest(1).items()}

    def curves(self) -> Arrays:
        """Returns ``eval_return``, and ``env_steps`` until then, [E, R] each."""
        return self._tables["evaluations"].columns()

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns which runs [R] have not used their budget, and how long their episodes are."""
        return self.used() < 1.0, self.lengths

    def share(self) -> float:
        """Returns the part of the budgets of all runs that is used."""
        return float(np.minimum(self.used(), 1.0).mean())

    def progress(self) -> Progress:
        """Returns how far the runs are; its fraction is ``share``."""
        steps, seconds = self._before
        past = {
            "eval_return": self.latest()["eval_return"][None],
            "env_steps": np.stack([steps, self.env_steps]),
            "updates": self.updates[None],
            "seconds": np.array([seconds, self.seconds]),
        }
        return measure_progress(past, np.array([self.share()] * 2))


class Chunk(Training):
    """The runs of a chunk as they go on, and its checkpoints."""

    record: ChunkRecord

    def __init__(
        self,
        compiled: Compiled,
        group: Group,
        runs: Runs,
        folder: Path,
        say: Callable[[str], None],
    ):
        """Begins, or goes on from the newest checkpoint that is there.

        Args:
          compiled: the programs of the group.
          group: of which the runs are.
          runs: the chunk's.
          folder: of its checkpoints.
          say: shows a line to the user.
        """
        config = dataclasses.replace(group.config, num_seeds=len(runs.seed))
        settings = {name: values[runs.place] for name, values in group.settings.items()}
        super().__init__(config, Slots(compiled, runs.seed, settings), ChunkRecord(config))
        self._folder, self._attempt = folder, Attempts(say).attempt
        self._due = SaveDue(config.checkpoint_every)
        like = shape_of_all(compiled.programs.like, len(runs.seed))
        found = next(checkpoint.read_checkpoints(folder, like, say), None)
        if found is not None:
            self.restore(found)
            self._due.saved(self.updates())

    def drive(self, interrupted: Callable[[], bool], show: Callable[[ChunkRecord], None]) -> bool:
        """Trains the runs to their end, or saves them where that is not to be waited for.

        A checkpoint that is due and cannot be written is a warning; it is tried again when the
        next one is due.

        Args:
          interrupted: whether the end is to be soon.
          show: shows how far the chunk is, after updates.

        Returns:
          Whether all runs ended.
        """
        config, record = self.config, self.record
        most = (config.checkpoint_every or MAX_COUNT) // config.eval_every
        for blocks in drive(self.slots, record, interrupted, most):
            record.add(blocks, self.seconds())
            if blocks[0].metrics:
                show(record)
            if self._due.is_due(self.updates()):
                self._attempt("a checkpoint", self.save)
                self._due.saved(self.updates())
        if record.finished() and record.is_evaluated():
            return True
        self.save()
        return False

    def save(self) -> None:
        """Writes a checkpoint, or raises OSError."""
        checkpoint.save(self._folder, self.checkpoint(), even=False)
