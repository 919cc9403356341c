"""What the seeds of a run have measured so far, in races too, and what follows from it."""

from typing import Any

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import summarize
from mjx_reinforce.training import failures, race
from mjx_reinforce.training.record import Measured, Progress, Record, joined, used
from mjx_reinforce.training.rows import as_rows

#: The time left is estimated from so many of the latest evaluations: episodes change their length.
_NUM_LATEST = 11


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
    broken_in_a_row: [R] see ``failures.broken_in_a_row``
    threshold: the return that counts as solved, if any
    """

    #: What a policy takes from its source, besides the tables.
    _of_lines = ("updates", "env_steps", "episodes", "seen", "broken_in_a_row")
    _saved = (
        *(*Record._saved, "episodes", "dropped_steps", "dropped_episodes", "cuts"),
        *("broken_in_a_row", "simulated", "evaluated"),
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
          What ``failures.nonfinite_updates`` does, of each seed.
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
        self.broken_in_a_row = failures.broken_in_a_row(self.broken_in_a_row, metrics)
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
        latest_columns = joined(
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
        min_broken = max(self.config.eval_every, failures.MIN_BROKEN)
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
