"""What runs have measured so far, and how far they are.

Blocks of training metrics and evaluations come in; rows of metrics.csv, curves, how far it is, and
the summary come out. Nothing here prints, writes a file, or reads a clock.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import iqm
from mjx_reinforce.training import failures


class Measured(NamedTuple):
    """What an evaluation of runs measured, and the updates that followed it.

    runs: [n] their numbers, the least first
    metrics: [K, n] each, what ``block_of_updates`` measured in at most K updates; empty without any
    eval_metrics: [n] each, what ``programs.evaluate`` returns of the policies before; empty without
      any
    """

    runs: np.ndarray
    metrics: Arrays
    eval_metrics: Arrays


def used(config: Config, env_steps: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns the fraction of its budget that each seed has used, of counts [..., S]."""
    budget_share = np.zeros(env_steps.shape)
    if config.env_steps is not None:
        budget_share = env_steps / config.env_steps
    if config.max_updates is not None:
        budget_share = np.maximum(budget_share, updates / config.max_updates)
    return budget_share


class Progress(NamedTuple):
    """How far runs are, such as the seeds of one, and what their last evaluation returned.

    fraction: how much of their budgets they have used, in the mean
    updates: made by the one that made the most
    env_steps: of the mean one
    iqm: interquartile mean of the returns, NaN where failed ones reach the middle half
    worst: the lowest return, NaN if one failed
    failed: how many returns are not finite
    num_seeds: of how many
    env_steps_per_second: of all together, the mean since the start
    seconds_left: an estimate, NaN before the first block
    """

    fraction: float
    updates: int
    env_steps: float
    iqm: float
    worst: float
    failed: int
    num_seeds: int
    env_steps_per_second: float
    seconds_left: float


def joined(tables: Sequence[Arrays]) -> Arrays:
    """Returns the rows of all pieces of a table, in order."""
    names = tables[0] if tables else ()
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


class Record:
    """What R runs have measured so far, such as a chunk of a sweep's.

    updates: [R] int64, how many each has made
    env_steps: [R] int64, how many each has played in training
    nonfinite: [R] int64, how many of its updates met numbers that are not finite
    returns: [R] of each run's latest evaluation
    seen: [R] int64, the env steps at which that was; -1 before the first
    lengths: [R] int64, of a sweep, the steps of all its episodes
    """

    #: What a checkpoint has besides the tables, under these names.
    _saved: tuple[str, ...] = ("updates", "env_steps", "nonfinite", "returns", "seen", "lengths")

    def __init__(self, config: Config):
        """Begins before the first update; R is ``config.num_policies``."""
        num_runs = config.num_policies
        self.config = config
        self.returns = np.zeros(num_runs, np.float32)
        self.updates = np.zeros(num_runs, np.int64)
        self.env_steps = np.zeros(num_runs, np.int64)
        self.nonfinite = np.zeros(num_runs, np.int64)
        self.lengths = np.zeros(num_runs, np.int64)
        self.seen = np.full(num_runs, -1, np.int64)
        #: Name -> pieces of the table, in order: named columns, [rows, ...] each.
        self._tables: dict[str, list[Arrays]] = {"evaluations": []}

    def arrays(self) -> Arrays:
        """Returns all that was measured, by name, for ``restore``."""
        record_arrays = {name: np.array(getattr(self, name)) for name in self._saved}
        for table in self._tables:
            record_arrays |= {f"{table}.{name}": x for name, x in self._columns(table).items()}
        return record_arrays

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Goes back to what a record of the same settings had measured.

        Args:
          saved: from its ``arrays``.
        """
        # Counts change in place, so they are copied; without an axis they were Python's ints.
        for name in self._saved:
            saved_array = saved[name]
            setattr(self, name, saved_array.copy() if saved_array.ndim else saved_array.item())
        # A table that had no rows has no columns, either.
        for table in self._tables:
            prefix = f"{table}."
            columns = {n.removeprefix(prefix): x for n, x in saved.items() if n.startswith(prefix)}
            self._tables[table] = [columns] if columns else []

    def _columns(self, table: str) -> Arrays:
        """Returns all rows of a table."""
        columns = joined(self._tables[table])
        # They stay joined: who asks after every evaluation would else join all of them each time.
        self._tables[table] = [columns] if columns else []
        return dict(columns)

    def begun(self) -> bool:
        """Returns whether there is an evaluation."""
        return bool(self._tables["evaluations"])

    def is_evaluated(self) -> bool:
        """Returns whether the present policies of all runs have been evaluated."""
        return np.array_equal(self.seen, self.env_steps)

    def used(self) -> np.ndarray:
        """Returns the fraction of its budget that each run has used."""
        return used(self.config, self.env_steps, self.updates)

    def used_up(self) -> float:
        """Returns how many budgets of one run the runs have used together."""
        return np.minimum(self.used(), 1.0).sum()

    def finished(self) -> bool:
        """Returns whether the budgets of all runs are used."""
        return bool(self.used().min() >= 1.0)

    def over(self) -> bool:
        """Returns whether no run is to go on."""
        return self.finished()

    def done(self) -> bool:
        """Returns whether no run is to go on, and the last policies are evaluated."""
        return self.over() and self.is_evaluated()

    def add_evaluation(self, measured: Measured, seconds: float) -> Arrays:
        """Takes in an evaluation of the present policies.

        Args:
          measured: in it; runs that made no update after it repeat their last evaluation.
          seconds: wall time since compilation ended, at which the policies were there.

        Returns:
          Its rows in metrics.csv, which a sweep has not.
        """
        runs, metrics, eval_metrics = measured
        # A run whose budget is used stands still. It is evaluated when all have ended, with no
        # block; until then it keeps its last evaluation, so that its rows depend on no other run.
        active = np.ones(len(runs), bool)
        if metrics:
            active = np.any(metrics["active"], axis=0)
        runs = runs[active]
        self.returns[runs] = eval_metrics["eval_return"][active]
        self.seen[runs] = self.env_steps[runs]
        self.lengths[runs] = eval_metrics["eval_steps"][active]
        self._append(eval_return=self.returns, env_steps=self.seen)
        return {}

    def _append(self, **row: np.ndarray) -> None:
        """Adds the row of an evaluation, such as [R]."""
        self._tables["evaluations"].append({name: x[None].copy() for name, x in row.items()})

    def add_updates(self, measured: Measured) -> np.ndarray:
        """Takes in a block of updates; returns what ``failures.nonfinite_updates`` does."""
        runs, metrics, _ = measured
        active = metrics["active"]
        num_nonfinite = failures.nonfinite_updates(metrics)
        self.updates[runs] += active.sum(axis=0)
        update_env_steps = np.where(active, metrics["env_steps"], 0)
        self.env_steps[runs] += update_env_steps.sum(axis=0, dtype=np.int64)
        self.nonfinite[runs] += num_nonfinite
        return num_nonfinite

    def played_steps(self) -> np.ndarray:
        """Returns the env steps that were played in training for each run."""
        return self.env_steps

    def moved(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Returns which runs [R] have not used their budget, and how long their episodes are."""
        return self.used() < 1.0, self.lengths

    def progress_at(
        self, fraction: float, seconds: float, gained_fraction: float, seconds_passed: float
    ) -> Progress:
        """Returns how far the runs are.

        Args:
          fraction: how much of their budgets they have used.
          seconds: in which they did that.
          gained_fraction: how much of the fraction was new, for an estimate of the time left.
          seconds_passed: seconds in which that came.
        """
        env_steps = self.played_steps()
        env_steps_per_second = math.nan
        if seconds > 0:
            env_steps_per_second = float(env_steps.sum() / seconds)
        seconds_left = math.nan
        if gained_fraction > 0:
            seconds_left = (1 - fraction) * seconds_passed / gained_fraction
        return Progress(
            fraction=fraction,
            updates=int(self.updates.max()),
            env_steps=float(env_steps.mean()),
            iqm=float(iqm(self.returns)),
            worst=float(self.returns.min()),
            failed=int(np.sum(~np.isfinite(self.returns))),
            num_seeds=len(self.returns),
            env_steps_per_second=env_steps_per_second,
            seconds_left=seconds_left,
        )

    def history(self) -> Arrays:
        """Returns what the evaluations measured, [E, R] each.

        That is ``eval_return``, the ``env_steps`` until then and, of a run, ``episodes``.
        """
        table = self._columns("evaluations")
        return {n: table[n] for n in ("eval_return", "env_steps", "episodes") if n in table}
