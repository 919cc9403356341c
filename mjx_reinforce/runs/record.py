"""What a run has measured so far, and what follows from it.

Blocks of training metrics and evaluations come in; rows of metrics.csv, curves, and the
summary come out. Nothing here prints, writes a file, or reads a clock.
"""

from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.reports.statistics import iqm, summarize
from mjx_reinforce.runs import rows
from mjx_reinforce.runs.config import Config

Arrays = dict[str, np.ndarray]


class Progress(NamedTuple):
    """How far a run is, as of its last evaluation.

    fraction: how much of its budget the seed furthest from its end has used, 1 or more at the end
    updates: made by the seed that made the most
    env_steps: of the mean seed
    iqm: interquartile mean of the return over seeds
    worst: the return of the worst seed
    env_steps_per_second: of all seeds together
    """

    fraction: float
    updates: int
    env_steps: float
    iqm: float
    worst: float
    env_steps_per_second: float


class Record:
    """Everything that a run has measured so far.

    updates: [S] int64, how many each seed has made
    env_steps: [S] int64, how many each seed has played in training
    threshold: the return that counts as solved, if any
    """

    def __init__(self, config: Config, threshold: float | None):
        """Begins before the first update.

        Args:
          config: the settings of the run.
          threshold: the return that counts as solved, if any.
        """
        self.updates = np.zeros(config.num_seeds, np.int64)
        self.env_steps = np.zeros(config.num_seeds, np.int64)
        self.threshold = threshold
        self._config = config
        self._evaluations: list[Arrays] = []
        self._training: list[Arrays] = []
        self._nonfinite: list[dict[str, Any]] = []
        self._last: Arrays = {}
        self._simulated = 0.0

    def add_updates(self, metrics: Arrays) -> list[dict[str, Any]]:
        """Takes in a block of updates.

        Args:
          metrics: [K, S] each, of K updates: those of ``Learner.step`` and of
            ``state.Programs.advance``.

        Returns:
          The seeds' updates in it that met numbers which are not finite: ``seed``, ``update``
          (how many were made before it), ``episodes`` (how many) and ``skipped``.
        """
        active = metrics["active"]
        env_steps = metrics["env_steps_total"].astype(np.int64)
        updates = metrics["updates_total"].astype(np.int64)
        made = active.any(axis=1)
        returns = np.where(active, metrics["episode_return"], np.nan)
        self._training.append(
            {
                "episode_return": returns[made],
                "env_steps": env_steps[made],
                "episodes": updates[made] * self._config.episodes_per_update,
            }
        )
        self.env_steps, self.updates = env_steps[-1], updates[-1]
        # All seeds step on until the slowest is done, also those whose budget is used.
        self._simulated += metrics["simulated_steps"].max(axis=1).sum() * active.shape[1]
        self._remember(metrics)
        nonfinite = _nonfinite_updates(metrics)
        self._nonfinite += nonfinite
        return nonfinite

    def _remember(self, metrics: Arrays) -> None:
        """Keeps each seed's metrics of its last update; a seed that stands still makes none."""
        made = metrics["active"].sum(axis=0)
        last = np.maximum(made - 1, 0)
        for name, values in metrics.items():
            newest = np.take_along_axis(values, last[None], axis=0)[0]
            self._last[name] = np.asarray(np.where(made > 0, newest, self._last.get(name, newest)))

    def add_evaluation(self, result: Arrays, seconds: float) -> list[dict[str, Any]]:
        """Takes in an evaluation [S] of the present policies.

        Args:
          result: what ``evaluation.evaluate`` returns, for each seed.
          seconds: wall time since compilation ended.

        Returns:
          The rows of metrics.csv, see ``rows``.
        """
        episodes = self.updates * self._config.episodes_per_update
        self._evaluations.append(result | {"env_steps": self.env_steps, "episodes": episodes})
        return rows.of_evaluation(
            result, self._last, self.updates, episodes, self.env_steps, seconds
        )

    def finished(self) -> bool:
        """Returns whether the budget is used, or all seeds are solved and that was to end it."""
        last = self._evaluations[-1]["eval_return"]
        solved = self.threshold is not None and np.all(last >= self.threshold)
        return bool(self._fraction() >= 1.0 or (self._config.stop_when_solved and solved))

    def _fraction(self) -> float:
        """Returns how much of its budget the seed furthest from its end has used."""
        used = np.zeros(self._config.num_seeds)
        if self._config.env_steps is not None:
            used = self.env_steps / self._config.env_steps
        if self._config.max_updates is not None:
            used = np.maximum(used, self.updates / self._config.max_updates)
        return float(used.min())

    def progress(self, seconds: float) -> Progress:
        """Returns how far the run is, ``seconds`` after compilation ended."""
        returns = self._evaluations[-1]["eval_return"]
        return Progress(
            fraction=self._fraction(),
            updates=int(self.updates.max()),
            env_steps=float(self.env_steps.mean()),
            iqm=float(iqm(returns)),
            worst=float(returns.min()),
            env_steps_per_second=float(self.env_steps.sum() / seconds),
        )

    def history(self) -> Arrays:
        """Returns ``eval_return``, and ``env_steps`` and ``episodes`` until then, [E, S] each."""
        return {
            name: np.stack([evaluation[name] for evaluation in self._evaluations])
            for name in ("eval_return", "env_steps", "episodes")
        }

    def training(self) -> Arrays:
        """Returns ``episode_return`` and the ``env_steps`` and ``episodes`` after it, [U, S]."""
        types = {"episode_return": np.float32, "env_steps": np.int64, "episodes": np.int64}
        return {
            name: np.concatenate(
                [np.zeros((0, self._config.num_seeds), kind)]
                + [block[name] for block in self._training]
            )
            for name, kind in types.items()
        }

    def content(self) -> Arrays:
        """Returns all that was measured, at least one evaluation, as arrays for ``restore``."""
        events = [[e[name] for name in _EVENT] for e in self._nonfinite]
        content = {
            "updates": self.updates,
            "env_steps": self.env_steps,
            "simulated": np.asarray(self._simulated),
            "nonfinite": np.array(events, np.int64).reshape(-1, len(_EVENT)),
        }
        for name in self._evaluations[0]:
            content[f"evaluations/{name}"] = np.stack([e[name] for e in self._evaluations])
        content |= {f"training/{name}": values for name, values in self.training().items()}
        return content | {f"last/{name}": values for name, values in self._last.items()}

    def restore(self, content: Arrays) -> None:
        """Takes in what ``content`` of the same run returned, in place of all that is here."""
        self.updates, self.env_steps = content["updates"], content["env_steps"]
        self._simulated = float(content["simulated"])
        self._nonfinite = [
            dict(zip(_EVENT, event, strict=True)) | {"skipped": bool(event[-1])}
            for event in content["nonfinite"].tolist()
        ]
        evaluations = _under("evaluations/", content)
        count = len(evaluations["eval_return"])
        self._evaluations = [{n: x[i] for n, x in evaluations.items()} for i in range(count)]
        self._training, self._last = [_under("training/", content)], _under("last/", content)

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
            **summarize(self.history(), self.threshold),
            "env_steps": self.env_steps.tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": run_seconds,
            "env_steps_per_second": float(env_steps / run_seconds),
            "useful_step_fraction": float(env_steps / max(self._simulated, 1.0)),
            "nonfinite": self._nonfinite,
        }


#: The entries of an update that met numbers which are not finite, see ``add_updates``.
_EVENT = ("seed", "update", "episodes", "skipped")


def _under(prefix: str, arrays: Arrays) -> Arrays:
    """Returns the arrays whose names begin so, without that beginning."""
    return {name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)}


def _nonfinite_updates(metrics: Arrays) -> list[dict[str, Any]]:
    """Returns the updates [K, S] that met numbers which are not finite, as ``add_updates``."""
    episodes, skipped = metrics["nonfinite_episodes"], metrics["skipped_update"]
    met = (episodes + skipped) * metrics["active"]
    return [
        {
            "seed": int(s),
            "update": int(metrics["updates_total"][k, s]) - 1,
            "episodes": int(episodes[k, s]),
            "skipped": bool(skipped[k, s]),
        }
        for k, s in zip(*np.nonzero(met), strict=True)
    ]
