"""What a run has measured so far, and what follows from it.

Blocks of training metrics and evaluations come in; rows of metrics.csv, curves, how far it is, and
the summary come out. Updates may meet numbers that are not finite: which ones, and when a seed is
past hope. Nothing here prints, writes a file, or reads a clock.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import iqm, summarize
from mjx_reinforce.training import race


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


COLUMNS = (
    "seed",
    "update",
    "episodes",
    "env_steps",
    "wall_seconds",
    "train_return",
    "eval_return",
    "eval_return_stochastic",
    "eval_length",
    "train_length",
    "entropy",
    "gradient_norm",
    "nonfinite_episodes",
    "skipped_update",
    "kl",
    "policy_std",
    "explained_variance",
    "gradient_snr",
)
#: How the columns behind these begin, one for each term of the reward.
TERM_COLUMN = "eval_reward"
#: What these columns are called among the metrics of an update.
_METRIC_OF_COLUMN = {"train_return": "episode_return", "train_length": "episode_length"}


def as_rows(measured: Arrays, seconds: float) -> Arrays:
    """Returns the rows of one evaluation in metrics.csv: column -> the values [S] of all seeds.

    Args:
      measured: [S] each, by column, or as ``_METRIC_OF_COLUMN``. What was not measured is no
        column; terms of the reward are those whose names begin with ``TERM_COLUMN``. A return is
        NaN if one of its episodes was not finite.
      seconds: wall time since compilation ended.
    """
    clock = np.full(len(measured["seed"]), round(seconds, 3))
    columns = {column: measured.get(_METRIC_OF_COLUMN.get(column, column)) for column in COLUMNS}
    terms = {name: x for name, x in measured.items() if name.startswith(TERM_COLUMN)}
    return {n: x for n, x in columns.items() if x is not None} | terms | {"wall_seconds": clock}


def header(terms: Sequence[str]) -> bytes:
    """Returns the first line of metrics.csv, for a task whose reward has these terms."""
    return (",".join([*COLUMNS, *(f"eval_{name}" for name in terms)]) + "\n").encode()


def lines(rows: Arrays, columns: Sequence[str] = COLUMNS) -> bytes:
    """Returns rows as metrics.csv has them; cells of what was not measured are empty.

    Args:
      rows: of ``as_rows``.
      columns: those of the file.
    """
    cells = {name: [""] * len(rows["seed"]) for name in columns}
    cells |= {name: _cells(rows[name]) for name in columns if name in rows}
    return "".join(",".join(row) + "\n" for row in zip(*cells.values(), strict=True)).encode()


def _cells(values: np.ndarray) -> Sequence[str]:
    """Returns values [S] as text that, read as their own type, is the same to the last bit."""
    if values.dtype != np.float32:
        return [*map(str, values.tolist())]
    # Nine digits tell any two float32 apart. A thousand in one format take 0.2 ms; one by one with
    # all digits of a double, 1 ms.
    texts = ("%.9g\n" * len(values) % tuple(values.tolist())).split()
    return [f"{text}.0" if text.lstrip("-").isdigit() else text for text in texts]


#: The time left is estimated from so many of the latest evaluations: episodes change their length.
_NUM_LATEST = 11


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


#: Why a run that is ``hopeless`` is stopped.
HOPELESS = (
    "every seed that still trained was broken throughout the last updates, its episodes "
    "or its new policy not finite; lower --learning-rate (ars: --step-size) or mend the task"
)
#: A run is not given up before each of its seeds was broken so many updates in a row: blocks may
#: be shorter, and a seed may recover from one such update, since the next draws other numbers.
_MIN_BROKEN = 5
#: A message names so many seeds.
_MAX_NAMED = 5


def nonfinite_updates(metrics: Arrays) -> np.ndarray:
    """Returns how many updates of a block met numbers which are not finite, of each seed [S].

    Args:
      metrics: [K, S] each, as in ``Measured``.
    """
    is_broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
    return (is_broken & metrics["active"]).sum(axis=0)


def broken_in_a_row(old_count: np.ndarray, metrics: Arrays) -> np.ndarray:
    """Returns how many of its latest updates each seed was broken in, without one between.

    An update is broken if all its episodes left the finite numbers, or if it was skipped.

    Args:
      old_count: [S] the same before this block.
      metrics: [K, S] each, as in ``Measured``.
    """
    is_broken = metrics["nonfinite_episodes"] >= metrics["episodes"]
    is_broken |= metrics["skipped_update"] > 0
    num_broken = old_count
    # One row [S] an update. A seed that stands still keeps its count: it was not tried.
    for active_row, is_broken_row in zip(metrics["active"], is_broken, strict=True):
        num_broken = np.where(active_row, np.where(is_broken_row, num_broken + 1, 0), num_broken)
    return num_broken


def describe_nonfinite(num_nonfinite: np.ndarray, first_seed: int, updates: int) -> str:
    """Returns a line about the first ``nonfinite_updates`` of a run, of which some are not 0.

    Args:
      num_nonfinite: [S] how many of a block, of each seed.
      first_seed: the number of the first seed.
      updates: how many there were after the block.
    """
    seeds = (first_seed + np.flatnonzero(num_nonfinite)).tolist()
    seed_list = ", ".join(map(str, seeds[:_MAX_NAMED]))
    if len(seeds) > _MAX_NAMED:
        seed_list += ", ..."
    noun = "number" if len(seeds) == 1 else "numbers"
    return (
        f"up to update {updates}, {len(seeds):,} of {len(num_nonfinite):,} seeds ({noun} "
        f"{seed_list}) met values that are not finite or beyond 1e10. Such an episode counts as "
        "the worst of its update. This line comes once; the number of such updates comes at the "
        "end. If they are many, give the model a smaller timestep or more armature, or lower "
        "--learning-rate"
    )


def _joined(tables: Sequence[Arrays]) -> Arrays:
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
        columns = _joined(self._tables[table])
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
        """Takes in a block of updates; returns what ``nonfinite_updates`` does."""
        runs, metrics, _ = measured
        active = metrics["active"]
        num_nonfinite = nonfinite_updates(metrics)
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


class RunRecord(Record):
    """Everything that the S seeds of a run have measured so far.

    In races, R policies are trained and S of them lead; without, each seed has one, which leads.
    What belongs to a policy is that of its line: a copy has what its source has.

    episodes: [R] int64, how many each policy has learned from
    dropped_steps, dropped_episodes: [R] int64, what those had learned from that were dropped here,
      less what their sources had
    cuts: [S] int64, how many cuts each race has had
    returns: [S] of each leader's latest evaluation
    simulated, evaluated: steps that were simulated, and those of evaluations
    broken_in_a_row: [R] see ``broken_in_a_row``
    threshold: the return that counts as solved, if any
    """

    #: What a policy takes from its source, besides the tables.
    _of_lines = ("updates", "env_steps", "episodes", "seen", "broken_in_a_row")
    _saved = (
        *Record._saved,
        "episodes",
        "dropped_steps",
        "dropped_episodes",
        "cuts",
        "broken_in_a_row",
        "simulated",
        "evaluated",
    )

    def __init__(self, config: Config, threshold: float | None):
        """Begins before the first update.

        Args:
          config: the settings of the run.
          threshold: the return that counts as solved, if any.
        """
        super().__init__(config)
        num_policies = config.num_policies
        self.threshold = threshold
        self.returns = np.zeros(config.num_seeds, np.float32)
        self.episodes = np.zeros(num_policies, np.int64)
        self.dropped_steps = np.zeros(num_policies, np.int64)
        self.dropped_episodes = np.zeros(num_policies, np.int64)
        self.cuts = np.zeros(config.num_seeds, np.int64)
        self.broken_in_a_row = np.zeros(num_policies, np.int64)
        # Python's ints, which do not overflow: both are sums over all seeds and all updates.
        self.simulated = 0
        self.evaluated = 0
        # A run that ends before its first update has these columns without rows.
        dtypes = {"episode_return": np.float32, "env_steps": np.int64, "episodes": np.int64}
        no_rows = {name: np.zeros((0, num_policies), dtype) for name, dtype in dtypes.items()}
        #: "last" has one row, the metrics of each seed's last update.
        self._tables |= {"training": [no_rows], "last": []}

    def moved(self) -> tuple[None, None]:
        """Returns None for all: a seed whose budget is used is still evaluated."""
        return None, None

    def played_steps(self) -> np.ndarray:
        """Returns the env steps [S] that all policies of a seed have played in training."""
        return self._of_seeds(self.env_steps + self.dropped_steps)

    def _of_seeds(self, policy_counts: np.ndarray) -> np.ndarray:
        """Returns counts of policies [..., R] summed over each seed's [..., S]."""
        seed_shape = (*policy_counts.shape[:-1], self.config.num_seeds, self.config.race)
        return policy_counts.reshape(seed_shape).sum(axis=-1)

    def scores(self) -> np.ndarray:
        """Returns by what policies are judged [R], see ``race.scores``."""
        return race.scores(self._columns("training")["episode_return"], self.updates)

    def leaders(self) -> np.ndarray:
        """Returns the number of each seed's policy [S]: of those that race the one that leads."""
        if self.config.race == 1:
            return np.arange(self.config.num_seeds)
        return race.leaders(self.scores(), self.config.race)

    def cut(self) -> np.ndarray | None:
        """Drops policies if that is due: in a race whose first one has used a share of its budget.

        Returns:
          The sources [R], see ``race.sources``; None if no cut is due.
        """
        used_most = self.used().reshape(-1, self.config.race).max(axis=1)
        passed_shares = np.searchsorted(race.SHARES, used_most, side="right")
        is_cut = passed_shares > self.cuts
        if self.config.race == 1 or not is_cut.any():
            return None
        policy_sources = race.sources(self.scores(), is_cut)
        self.cuts = np.maximum(self.cuts, passed_shares)
        self.dropped_steps += self.env_steps - self.env_steps[policy_sources]
        self.dropped_episodes += self.episodes - self.episodes[policy_sources]
        for name in self._of_lines:
            setattr(self, name, getattr(self, name)[policy_sources])
        for table in ("training", "last"):
            columns = self._columns(table)
            self._tables[table] = [{name: x[:, policy_sources] for name, x in columns.items()}]
        return policy_sources

    def add_updates(self, measured: Measured) -> np.ndarray:
        """Takes in a block of updates.

        A training return is NaN if one of its episodes left the finite numbers.

        Args:
          measured: the metrics are those of ``Learner.step`` and of ``block_of_updates``.

        Returns:
          What ``nonfinite_updates`` does, of each seed.
        """
        metrics = measured.metrics
        active = metrics["active"]
        is_finite = metrics["nonfinite_episodes"] == 0
        returns = np.where(is_finite, metrics["episode_return"], np.nan)
        episodes = active * metrics["episodes"]
        training_sums = {
            "episode_return": np.where(active, returns, np.nan),
            "env_steps": self.env_steps + np.cumsum(metrics["env_steps"], axis=0, dtype=np.int64),
            "episodes": self.episodes + np.cumsum(episodes, axis=0, dtype=np.int64),
        }
        # The last block may end early: rows in which no seed made an update are none.
        updates = active.any(axis=1)
        self._tables["training"].append({name: x[updates] for name, x in training_sums.items()})
        self.episodes = training_sums["episodes"][-1]
        self.simulated += _sum(metrics["simulated_steps"])
        self.broken_in_a_row = broken_in_a_row(self.broken_in_a_row, metrics)
        self._remember(metrics | {"episode_return": returns})
        return self._of_seeds(super().add_updates(measured))

    def _remember(self, metrics: Arrays) -> None:
        """Keeps each seed's metrics of its last update; a seed that stands still makes none."""
        # A seed makes its updates first and then stands still, so their count is the row after the
        # last one.
        num_updates = metrics["active"].sum(axis=0)
        last_index = np.maximum(num_updates - 1, 0)[None]
        newest_metrics = {
            name: np.take_along_axis(x, last_index, axis=0) for name, x in metrics.items()
        }
        old_metrics = self._columns("last") or newest_metrics
        has_moved = num_updates > 0
        self._tables["last"] = [
            {n: np.where(has_moved, x, old_metrics[n]) for n, x in newest_metrics.items()}
        ]

    def add_evaluation(self, measured: Measured, seconds: float) -> Arrays:
        """Takes in an evaluation [R] of the present policies.

        Args:
          measured: in it.
          seconds: wall time since compilation ended.

        Returns:
          The rows of the leaders in metrics.csv.
        """
        eval_metrics = measured.eval_metrics
        leaders = self.leaders()
        self._append(
            **eval_metrics,
            env_steps=self.env_steps,
            played_steps=self.env_steps + self.dropped_steps,
            episodes=self.episodes + self.dropped_episodes,
            updates=self.updates,
            leads=np.isin(np.arange(self.config.num_policies), leaders),
            seconds=np.array(seconds),
        )
        self.count_steps(eval_metrics)
        self.returns = eval_metrics["eval_return"][leaders]
        self.seen = self.env_steps.copy()
        last_metrics = {name: x[0] for name, x in self._columns("last").items()}
        policy_metrics = last_metrics | eval_metrics | {"update": self.updates}
        leader_metrics = {name: x[leaders] for name, x in policy_metrics.items()}
        # Columns of metrics.csv are singular: a row is of one update of one seed.
        counts = {
            "seed": self.config.first_seed + np.arange(self.config.num_seeds),
            "env_steps": self.played_steps(),
            "episodes": self._of_seeds(self.episodes + self.dropped_episodes),
        }
        return as_rows(leader_metrics | counts, seconds)

    def progress(self) -> Progress:
        """Returns how far the run is, right after an evaluation."""
        names = ("env_steps", "updates", "seconds")
        # A piece may have one row or all of the past: each is cut, then they are joined and cut.
        tables = self._tables["evaluations"][-_NUM_LATEST:]
        latest_columns = _joined(
            [{name: table[name][-_NUM_LATEST:] for name in names} for table in tables]
        )
        latest_rows = {name: x[-_NUM_LATEST:] for name, x in latest_columns.items()}
        budget_shares = used(self.config, latest_rows["env_steps"], latest_rows["updates"])
        budget_shares = np.minimum(budget_shares, 1.0).mean(axis=-1).tolist()
        seconds = latest_rows["seconds"].tolist()
        return self.progress_at(
            fraction=budget_shares[-1],
            seconds=seconds[-1],
            gained_fraction=budget_shares[-1] - budget_shares[0],
            seconds_passed=seconds[-1] - seconds[0],
        )

    def count_steps(self, eval_metrics: Arrays) -> None:
        """Counts the steps of an evaluation or a test, of what ``programs.evaluate`` returns."""
        self.simulated += _sum(eval_metrics["simulated_steps"])
        self.evaluated += _sum(eval_metrics["eval_steps"])

    def over(self) -> bool:
        """Returns whether the budget is used, or nothing is finite any more."""
        return self.finished() or self.hopeless()

    def hopeless(self) -> bool:
        """Returns whether all seeds that still train were broken throughout a block of updates."""
        is_training = self.used() < 1.0
        min_broken = max(self.config.eval_every, _MIN_BROKEN)
        return bool(is_training.any() and np.all(self.broken_in_a_row[is_training] >= min_broken))

    def training(self) -> Arrays:
        """Returns ``episode_return`` and the ``env_steps`` and ``episodes`` after it, [U, S].

        A return is NaN where the seed stood still or an episode left the finite numbers. Of a race
        this is the line of its leader alone.
        """
        return {name: x[:, self.leaders()] for name, x in self._columns("training").items()}

    def history(self) -> Arrays:
        """Returns what the evaluations of the leaders measured, [E, S] each, see ``Record``.

        The env steps and the episodes are of all policies of a seed together.
        """
        table = self._columns("evaluations")
        if not table:
            return {}
        policy_returns = table["eval_return"]
        return {
            "eval_return": policy_returns[table["leads"]].reshape(-1, self.config.num_seeds),
            "env_steps": self._of_seeds(table["played_steps"]),
            "episodes": self._of_seeds(table["episodes"]),
        }

    def summary(self, engine: str, compile_seconds: float, run_seconds: float) -> dict[str, Any]:
        """Returns what summary.json says.

        Args:
          engine: the name of the engine that played.
          compile_seconds: wall time of compiling.
          run_seconds: wall time since then.
        """
        env_steps = self.played_steps().sum()
        return {
            "env": self.config.env,
            "engine": engine,
            "num_seeds": self.config.num_seeds,
            "race": self.config.race,
            "threshold": self.threshold,
            **summarize(self.history(), self.threshold),
            "env_steps": self.played_steps().tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": run_seconds,
            "env_steps_per_second": float(env_steps / run_seconds),
            "useful_step_fraction": float((env_steps + self.evaluated) / max(self.simulated, 1)),
            "nonfinite": self._of_seeds(self.nonfinite).tolist(),
        }


def _sum(step_counts: np.ndarray) -> int:
    """Returns the sum of counts that may be too many for their own type."""
    return int(step_counts.sum(dtype=np.int64))
