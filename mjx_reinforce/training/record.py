"""What a run has measured so far, and what follows from it.

Blocks of training metrics and evaluations come in; rows of metrics.csv, curves, and the
summary come out. Nothing here prints, writes a file, or reads a clock.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import summarize
from mjx_reinforce.training import progress
from mjx_reinforce.training.progress import BLOCKS, Progress, measure_progress, used

if TYPE_CHECKING:
    from mjx_reinforce.training.slots import Measured

#: The rows of one evaluation as text: column -> the cells of all seeds; columns as in ``COLUMNS``.
Cells = Mapping[str, Sequence[str]]

COLUMNS = (
    *("seed", "update", "episodes", "env_steps", "wall_seconds"),
    *("train_return", "eval_return", "eval_return_stochastic", "eval_length", "train_length"),
    *("entropy", "gradient_norm", "nonfinite_episodes", "skipped_update"),
    *("kl", "policy_std", "explained_variance", "gradient_snr", "clipped_gradients"),
)
HEADER = (",".join(COLUMNS) + "\n").encode()
#: Columns that an evaluation measures.
_EVALUATION = ("eval_return", "eval_return_stochastic", "eval_length")
#: Columns that the last update measured, and the names of its metrics: the same, but for two.
_RENAMED = {"train_return": "episode_return", "train_length": "episode_length"}
_LAST_UPDATE = _RENAMED | {name: name for name in COLUMNS[COLUMNS.index("entropy") :]}


def of_evaluation(
    evaluation: dict[str, np.ndarray],
    last_update: dict[str, np.ndarray],
    updates: np.ndarray,
    episodes: np.ndarray,
    env_steps: np.ndarray,
    seconds: float,
    first_seed: int = 0,
) -> Cells:
    """Returns the cells of all seeds; a return is NaN if one of its episodes was not finite.

    Args:
      evaluation: [S] each, what ``block.evaluate`` returns.
      last_update: [S] each, the metrics of each seed's last update; empty before the first. The
        columns of metrics that a learner does not have are empty.
      updates: [S] how many were made.
      episodes: [S] how many were played for them.
      env_steps: [S] and how many env steps.
      seconds: wall time since compilation ended.
      first_seed: the number of the first seed.
    """
    num_seeds = len(updates)
    columns: dict[str, Sequence[str]] = {
        "seed": _cells(first_seed + np.arange(num_seeds)),
        "update": _cells(updates),
        "episodes": _cells(episodes),
        "env_steps": _cells(env_steps),
        "wall_seconds": [f"{seconds:.3f}"] * num_seeds,
    }
    for name in _EVALUATION:
        columns[name] = _cells(evaluation[name])
    for name, metric in _LAST_UPDATE.items():
        measured = last_update.get(metric)
        columns[name] = [""] * num_seeds if measured is None else _cells(measured)
    return {name: columns[name] for name in COLUMNS}


def lines(rows: Cells) -> bytes:
    """Returns rows as metrics.csv has them."""
    return "".join(",".join(row) + "\n" for row in zip(*rows.values(), strict=True)).encode()


def _cells(values: np.ndarray) -> Sequence[str]:
    """Returns values [S] as text that, read as their own type, is the same to the last bit."""
    if values.dtype != np.float32:
        return [*map(str, values.tolist())]
    # Nine digits tell any two float32 apart. A thousand in one format take 0.2 ms; one by one with
    # all digits of a double, 1 ms.
    texts = ("%.9g\n" * len(values) % tuple(values.tolist())).split()
    return [f"{text}.0" if text.lstrip("-").isdigit() else text for text in texts]


class GrowingTable:
    """Named columns [rows, ...] that grow by blocks of rows."""

    def __init__(self, columns: Arrays):
        """Begins with columns, which may be without rows, or with none at all."""
        self._blocks = [columns] if columns else []

    def append(self, block: Arrays) -> None:
        """Takes in rows: every column, [rows, ...] each."""
        self._blocks.append(block)

    def columns(self) -> Arrays:
        """Returns all rows."""
        if len(self._blocks) > 1:
            self._blocks = [_joined(self._blocks)]
        return dict(self._blocks[0]) if self._blocks else {}

    def latest(self, count: int, *names: str) -> Arrays:
        """Returns the last ``count`` rows, of blocks none of which is empty, or all there are.

        Args:
          count: how many rows.
          names: of the columns; all if none is named.
        """
        if not self._blocks:
            return {}
        tails = [{name: b[name][-count:] for name in names or b} for b in self._blocks[-count:]]
        return {name: x[-count:] for name, x in _joined(tails).items()}


def _joined(blocks: list[Arrays]) -> Arrays:
    """Returns the rows of all blocks, in order."""
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _of_group(arrays: Mapping[str, np.ndarray], group: str) -> Arrays:
    """Returns the arrays whose names begin with ``group`` and a dot, without these."""
    start = f"{group}."
    return {name.removeprefix(start): x for name, x in arrays.items() if name.startswith(start)}


class Record:
    """What R runs have measured so far, such as the seeds of one run.

    updates: [R] int64, how many each has made
    env_steps: [R] int64, how many each has played in training
    nonfinite: [R] int64, how many of its updates met numbers that are not finite
    seconds: wall time from the end of compilation to what was measured last
    """

    #: What a checkpoint has besides the tables.
    _kept: tuple[str, ...] = ("updates", "env_steps", "nonfinite", "seconds")

    def __init__(self, config: Config):
        """Begins before the first update; R is ``config.num_seeds``."""
        self.config = config
        self.updates = np.zeros(config.num_seeds, np.int64)
        self.env_steps = np.zeros(config.num_seeds, np.int64)
        self.nonfinite = np.zeros(config.num_seeds, np.int64)
        self.seconds = 0.0
        self._tables = {"evaluations": GrowingTable({})}

    def arrays(self) -> Arrays:
        """Returns all that was measured, by name, for ``restore``."""
        arrays = {name: np.asarray(getattr(self, name)) for name in self._kept}
        for group, table in self._tables.items():
            arrays |= {f"{group}.{name}": values for name, values in table.columns().items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Goes back to what a record of the same settings had measured.

        Args:
          arrays: from its ``arrays``.
        """
        for name in self._kept:
            value = arrays[name]
            setattr(self, name, value if value.ndim else value.item())
        for group in self._tables:
            self._tables[group] = GrowingTable(_of_group(arrays, group))

    def begun(self) -> bool:
        """Returns whether there is an evaluation."""
        return bool(self._tables["evaluations"].latest(1))

    def is_evaluated(self) -> bool:
        """Returns whether the present policies of all runs have been evaluated."""
        last = self._tables["evaluations"].latest(1, "env_steps")
        return bool(last) and np.array_equal(last["env_steps"][0], self.env_steps)

    def used(self) -> np.ndarray:
        """Returns the fraction of its budget that each run has used."""
        return used(self.config, self.env_steps, self.updates)

    def finished(self) -> bool:
        """Returns whether the budgets of all runs are used."""
        return bool(self.used().min() >= 1.0)

    def over(self) -> bool:
        """Returns whether no run is to go on."""
        return self.finished()

    def done(self) -> bool:
        """Returns whether no run is to go on, and the last policies are evaluated."""
        return self.over() and self.is_evaluated()

    def add(self, blocks: Sequence["Measured"], seconds: float) -> None:
        """Takes in evaluations and the updates after them.

        Args:
          blocks: one after the other; runs that made no update in it stay as they are.
          seconds: wall time since the beginning.
        """
        raise NotImplementedError

    def progress(self) -> Progress:
        """Returns how far the runs are."""
        raise NotImplementedError

    def moved(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Returns which runs [R] move on, and about how long their episodes are [R].

        None stands for all: a seed of a run whose budget is used is still evaluated.
        """
        return None, None


class Runs(NamedTuple):
    """Runs of a sweep that move on together.

    name: of these, for their files
    place: [R] the configuration of each run, counted within its group
    configuration: [R] the same, counted in the sweep
    seed: [R]
    """

    name: str
    place: np.ndarray
    configuration: np.ndarray
    seed: np.ndarray


class ChunkRecord(Record):
    """What the R runs of a chunk of a sweep have measured.

    runs: which they are
    lengths: [R] the steps of all episodes of each run's latest evaluation
    """

    _kept = (*Record._kept, "lengths")

    def __init__(self, config: Config, runs: Runs):
        """Begins before the first update; R is ``config.num_seeds``."""
        super().__init__(config)
        self.runs = runs
        self.lengths = np.zeros(config.num_seeds, np.int64)
        self._before = self.env_steps, self.seconds

    def add(self, blocks: Sequence["Measured"], seconds: float) -> None:
        """Takes in what was measured; of runs that made no update in a block, nothing."""
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
        self.updates[runs] += metrics["active"].sum(axis=0)
        steps = np.where(metrics["active"], metrics["env_steps"], 0)
        self.env_steps[runs] += steps.sum(axis=0, dtype=np.int64)
        self.nonfinite[runs] += progress.nonfinite_updates(metrics)

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


class RunRecord(Record):
    """Everything that the S seeds of a run have measured so far.

    episodes: [S] int64, how many each seed has played in training
    simulated, evaluated: steps that were simulated, and those of evaluations
    broken_in_a_row: [S] see ``progress.broken_in_a_row``
    threshold: the return that counts as solved, if any
    """

    _kept = (*Record._kept, "episodes", "broken_in_a_row", "simulated", "evaluated")

    def __init__(self, config: Config, threshold: float | None):
        """Begins before the first update.

        Args:
          config: the settings of the run.
          threshold: the return that counts as solved, if any.
        """
        super().__init__(config)
        self.threshold, num_seeds = threshold, config.num_seeds
        self.episodes = np.zeros(num_seeds, np.int64)
        self.broken_in_a_row = np.zeros(num_seeds, np.int64)
        self.simulated = self.evaluated = 0
        kinds = {"episode_return": np.float32, "env_steps": np.int64, "episodes": np.int64}
        first = {name: np.zeros((0, num_seeds), kind) for name, kind in kinds.items()}
        self._tables["training"] = GrowingTable(first)
        self._last: Arrays = {}

    def arrays(self) -> Arrays:
        """Returns all that was measured, by name, for ``restore``."""
        return super().arrays() | {f"last.{name}": x for name, x in self._last.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Goes back to what a record of the same settings had measured."""
        super().restore(arrays)
        self._last = _of_group(arrays, "last")

    def add_updates(self, metrics: Arrays) -> np.ndarray:
        """Takes in a block of updates.

        A training return is NaN if one of its episodes left the finite numbers.

        Args:
          metrics: [K, S] each, of K updates: those of ``Learner.step`` and of
            ``block_of_updates``.

        Returns:
          What ``progress.nonfinite_updates`` does.
        """
        active, played = metrics["active"], metrics["episodes"]
        finite = metrics["nonfinite_episodes"] == 0
        env_steps = self.env_steps + np.cumsum(metrics["env_steps"], axis=0, dtype=np.int64)
        updates = self.updates + np.cumsum(active, axis=0, dtype=np.int64)
        episodes = self.episodes + np.cumsum(active * played, axis=0, dtype=np.int64)
        made = active.any(axis=1)
        returns = np.where(finite, metrics["episode_return"], np.nan)
        training = {
            "episode_return": np.where(active, returns, np.nan),
            "env_steps": env_steps,
            "episodes": episodes,
        }
        self._tables["training"].append({name: x[made] for name, x in training.items()})
        self.env_steps, self.updates = env_steps[-1], updates[-1]
        self.episodes = episodes[-1]
        self.simulated += _sum(metrics["simulated_steps"])
        self.broken_in_a_row = progress.broken_in_a_row(self.broken_in_a_row, metrics)
        met = progress.nonfinite_updates(metrics)
        self.nonfinite = self.nonfinite + met
        self._remember(metrics | {"episode_return": returns})
        return met

    def _remember(self, metrics: Arrays) -> None:
        """Keeps each seed's metrics of its last update; a seed that stands still makes none."""
        made = metrics["active"].sum(axis=0)
        last = np.maximum(made - 1, 0)
        for name, values in metrics.items():
            newest = np.take_along_axis(values, last[None], axis=0)[0]
            self._last[name] = np.asarray(np.where(made > 0, newest, self._last.get(name, newest)))

    def add_evaluation(self, result: Arrays, seconds: float) -> Cells:
        """Takes in an evaluation [S] of the present policies.

        Args:
          result: what ``block.evaluate`` returns, for each seed.
          seconds: wall time since compilation ended.

        Returns:
          The cells of its rows in metrics.csv, see ``of_evaluation``.
        """
        counts = {"env_steps": self.env_steps, "episodes": self.episodes, "updates": self.updates}
        row = result | counts | {"seconds": np.asarray(seconds, np.float64)}
        self._tables["evaluations"].append({name: x[None] for name, x in row.items()})
        self._count(result)
        self.seconds = seconds
        return of_evaluation(
            *(result, self._last, self.updates, self.episodes, self.env_steps, seconds),
            first_seed=self.config.first_seed,
        )

    def add_test(self, result: Arrays) -> None:
        """Counts what a test of final policies simulated, of ``block.evaluate``."""
        self._count(result)

    def _count(self, result: Arrays) -> None:
        self.simulated += _sum(result["simulated_steps"])
        self.evaluated += _sum(result["eval_steps"])

    def over(self) -> bool:
        """Returns whether the budget is used, or nothing is finite any more."""
        return self.finished() or self.hopeless()

    def hopeless(self) -> bool:
        """Returns whether all seeds that still train were broken throughout a block of updates."""
        return progress.hopeless(self.broken_in_a_row, self.used(), self.config.eval_every)

    def progress(self) -> Progress:
        """Returns how far the run is, as of its last evaluation."""
        names = ("eval_return", "env_steps", "updates", "seconds")
        past = self._tables["evaluations"].latest(BLOCKS + 1, *names)
        fractions = used(self.config, past["env_steps"], past["updates"]).min(axis=-1)
        return measure_progress(past, fractions)

    def history(self) -> Arrays:
        """Returns ``eval_return``, and ``env_steps`` and ``episodes`` until then, [E, S] each."""
        past = self._tables["evaluations"].columns()
        return {name: past[name] for name in ("eval_return", "env_steps", "episodes")}

    def training(self) -> Arrays:
        """Returns ``episode_return`` and the ``env_steps`` and ``episodes`` after it, [U, S].

        A return is NaN where the seed stood still or an episode left the finite numbers.
        """
        return self._tables["training"].columns()

    def summary(self, engine: str, compile_seconds: float, run_seconds: float) -> dict[str, Any]:
        """Returns what summary.json says.

        Args:
          engine: the name of the engine that played.
          compile_seconds: wall time of compiling.
          run_seconds: wall time since then.
        """
        env_steps = self.env_steps.sum()
        return {
            "env": self.config.env,
            "engine": engine,
            "num_seeds": self.config.num_seeds,
            "threshold": self.threshold,
            **summarize(self.history(), self.threshold),
            "env_steps": self.env_steps.tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": run_seconds,
            "env_steps_per_second": float(env_steps / run_seconds),
            "useful_step_fraction": float((env_steps + self.evaluated) / max(self.simulated, 1)),
            "nonfinite": self.nonfinite.tolist(),
        }


def _sum(steps: np.ndarray) -> int:
    """Returns the sum of counts that may be too many for their own type."""
    return int(steps.sum(dtype=np.int64))
