"""What a run has measured so far, and what follows from it.

Blocks of training metrics and evaluations come in; rows of metrics.csv, curves, and the
summary come out. Nothing here prints, writes a file, or reads a clock.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import summarize
from mjx_reinforce.training import progress
from mjx_reinforce.training.progress import BLOCKS, Progress, measure_progress, used

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


class RunRecord:
    """Everything that a run has measured so far.

    updates: [S] int64, how many each seed has made
    env_steps: [S] int64, how many each seed has played in training
    episodes: [S] int64, how many each seed has played in training
    seconds: wall time from the end of compilation to the last evaluation
    threshold: the return that counts as solved, if any
    """

    def __init__(self, config: Config, threshold: float | None):
        """Begins before the first update.

        Args:
          config: the settings of the run.
          threshold: the return that counts as solved, if any.
        """
        self._config, self.threshold = config, threshold
        self.updates = np.zeros(config.num_seeds, np.int64)
        self.env_steps = np.zeros(config.num_seeds, np.int64)
        self.episodes = np.zeros(config.num_seeds, np.int64)
        self.seconds = 0.0
        kinds = {"episode_return": np.float32, "env_steps": np.int64, "episodes": np.int64}
        self._tables = {
            "evaluations": GrowingTable({}),
            "training": GrowingTable(
                {k: np.zeros((0, config.num_seeds), x) for k, x in kinds.items()}
            ),
            "nonfinite": GrowingTable(
                {k: np.zeros(0, x) for k, x in progress.EVENT_COLUMNS.items()}
            ),
        }
        self._last: Arrays = {}
        self._broken_in_a_row = np.zeros(config.num_seeds, np.int64)
        self._simulated = self._evaluated = 0

    def arrays(self) -> Arrays:
        """Returns all that was measured, by name, for ``restore``."""
        kept = {
            "updates": self.updates,
            "env_steps": self.env_steps,
            "episodes": self.episodes,
            "seconds": np.asarray(self.seconds, np.float64),
            "broken_in_a_row": self._broken_in_a_row,
            "simulated": np.asarray(self._simulated, np.int64),
            "evaluated": np.asarray(self._evaluated, np.int64),
        }
        tables = {name: table.columns() for name, table in self._tables.items()}
        for group, columns in (tables | {"last": self._last}).items():
            kept |= {f"{group}.{name}": values for name, values in columns.items()}
        return kept

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Goes back to what a record of the same settings had measured.

        Args:
          arrays: from its ``arrays``.
        """
        groups: dict[str, Arrays] = {"last": {}} | {name: {} for name in self._tables}
        for key, values in arrays.items():
            group, _, name = key.rpartition(".")
            if group:
                groups[group][name] = values
        self.updates, self.env_steps = arrays["updates"], arrays["env_steps"]
        self.episodes = arrays["episodes"]
        self.seconds, self._simulated = float(arrays["seconds"]), int(arrays["simulated"])
        self._evaluated = int(arrays["evaluated"])
        self._broken_in_a_row = arrays["broken_in_a_row"]
        self._last = groups.pop("last")
        self._tables = {name: GrowingTable(columns) for name, columns in groups.items()}

    def add_updates(self, metrics: Arrays) -> Arrays:
        """Takes in a block of updates.

        A training return is NaN if one of its episodes left the finite numbers.

        Args:
          metrics: [K, S] each, of K updates: those of ``Learner.step`` and of
            ``state.Programs.advance``.

        Returns:
          The updates in it that met numbers which are not finite, see
          ``progress.nonfinite_updates``.
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
        self._simulated += _sum(metrics["simulated_steps"])
        self._broken_in_a_row = progress.broken_in_a_row(self._broken_in_a_row, metrics)
        met = progress.nonfinite_updates(metrics, updates)
        met["seed"] += self._config.first_seed
        self._tables["nonfinite"].append(met)
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
            first_seed=self._config.first_seed,
        )

    def add_test(self, result: Arrays) -> None:
        """Counts what a test of final policies simulated, of ``block.evaluate``."""
        self._count(result)

    def _count(self, result: Arrays) -> None:
        self._simulated += _sum(result["simulated_steps"])
        self._evaluated += _sum(result["eval_steps"])

    def evaluated(self) -> bool:
        """Returns whether the present policies have been evaluated."""
        last = self._tables["evaluations"].latest(1)
        return bool(last) and np.array_equal(last["updates"][0], self.updates)

    def begun(self) -> bool:
        """Returns whether there is an evaluation."""
        return bool(self._tables["evaluations"].latest(1))

    def finished(self) -> bool:
        """Returns whether the budget is used."""
        return bool(used(self._config, self.env_steps, self.updates).min() >= 1.0)

    def hopeless(self) -> bool:
        """Returns whether all seeds that still train were broken throughout a block of updates."""
        share = used(self._config, self.env_steps, self.updates)
        return progress.hopeless(self._broken_in_a_row, share, self._config.eval_every)

    def progress(self) -> Progress:
        """Returns how far the run is, as of its last evaluation."""
        names = ("eval_return", "env_steps", "updates", "seconds")
        past = self._tables["evaluations"].latest(BLOCKS + 1, *names)
        fractions = used(self._config, past["env_steps"], past["updates"]).min(axis=-1)
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
            "env": self._config.env,
            "engine": engine,
            "num_seeds": self._config.num_seeds,
            "threshold": self.threshold,
            **summarize(self.history(), self.threshold),
            "env_steps": self.env_steps.tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": run_seconds,
            "env_steps_per_second": float(env_steps / run_seconds),
            "useful_step_fraction": float((env_steps + self._evaluated) / max(self._simulated, 1)),
            "nonfinite": progress.as_events(self._tables["nonfinite"].columns()),
        }


def _sum(steps: np.ndarray) -> int:
    """Returns the sum of counts that may be too many for their own type."""
    return int(steps.sum(dtype=np.int64))
