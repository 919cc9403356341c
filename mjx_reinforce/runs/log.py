"""What a run has measured so far, and the files it goes to."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.runs import files as records
from mjx_reinforce.export.files import write_bytes, write_json
from mjx_reinforce.reports import curves as report
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.display import Display
from mjx_reinforce.reports.statistics import iqm


class RunLog:
    """Everything measured so far, and the files it goes to."""

    def __init__(
        self,
        config: Config,
        directory: Path,
        display: Display,
        engine: str,
        threshold: float | None,
    ):
        self.used = np.zeros(config.num_seeds, np.int64)
        self._config, self._directory, self._display = config, directory, display
        self._engine, self._threshold = engine, threshold
        self._rows: list[dict[str, Any]] = []
        self._evaluations: list[dict[str, np.ndarray]] = []
        self._training: list[dict[str, np.ndarray]] = []
        self._broken: list[dict[str, Any]] = []
        self._last: dict[str, np.ndarray] = {}
        self._simulated = 0.0
        self._update = np.zeros(config.num_seeds, np.int64)
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time since compilation ended."""
        return time.perf_counter() - self._started

    def updates(self, metrics: dict[str, np.ndarray]) -> None:
        """Takes in the metrics [K, S] of a block of updates."""
        active = metrics["active"]
        steps = np.where(active, metrics["env_steps"], 0)
        made = active.any(axis=1)
        returns = np.where(active, metrics["episode_return"], np.nan)
        used = self.used + np.cumsum(steps, axis=0, dtype=np.int64)
        updates = self._update + np.cumsum(active, axis=0)
        self._training.append(
            {
                "episode_return": returns[made],
                "env_steps": used[made],
                "episodes": updates[made] * self._config.episodes_per_update,
            }
        )
        self.used = used[-1]
        # All seeds step on until the slowest is done, also those whose budget is used.
        self._simulated += metrics["simulated_steps"].max(axis=1).sum() * steps.shape[1]
        self._remember(metrics)
        broken = (metrics["nonfinite_episodes"] + metrics["skipped_update"]) * active
        for k, s in zip(*np.nonzero(broken), strict=True):
            episodes, skipped = metrics["nonfinite_episodes"][k, s], metrics["skipped_update"][k, s]
            self._report_broken(int(s), int(self._update[s] + k), int(episodes), bool(skipped))
        self._update += active.sum(axis=0)

    def finished(self) -> bool:
        """Whether the budget is used, or was asked to end early by what is solved."""
        last = self._evaluations[-1]["eval_return"] if self._evaluations else np.array(-np.inf)
        solved = self._threshold is not None and np.all(last >= self._threshold)
        return bool(self._done() >= 1.0 or (self._config.stop_when_solved and solved))

    def _done(self) -> float:
        """Returns the fraction of the budget that the seed furthest from its end has used."""
        done = np.zeros(self._config.num_seeds)
        if self._config.env_steps is not None:
            done = self.used / self._config.env_steps
        if self._config.max_updates is not None:
            done = np.maximum(done, self._update / self._config.max_updates)
        return float(done.min())

    def _remember(self, metrics: dict[str, np.ndarray]) -> None:
        """Keeps each seed's metrics of its last update; a seed that stands still makes none."""
        made = metrics["active"].sum(axis=0)
        last = np.maximum(made - 1, 0)
        for name, values in metrics.items():
            newest = np.take_along_axis(values, last[None], axis=0)[0]
            self._last[name] = np.asarray(np.where(made > 0, newest, self._last.get(name, newest)))

    def _report_broken(self, seed: int, update: int, episodes: int, skipped: bool) -> None:
        self._broken.append(
            {"seed": seed, "update": update, "episodes": episodes, "skipped": skipped}
        )
        what = f"{episodes} non-finite episodes" + (", update skipped" if skipped else "")
        self._display.say(f"[yellow]seed {seed}, update {update}: {what}[/yellow]")

    def evaluation(self, result: dict[str, np.ndarray]) -> None:
        """Takes in an evaluation [S], shows it, and writes metrics.csv."""
        episodes = self._update * self._config.episodes_per_update
        self._evaluations.append(result | {"env_steps": self.used.copy(), "episodes": episodes})
        for s in range(self._config.num_seeds):
            self._rows.append(self._row(s, result))
        records.write_csv(self._directory / "metrics.csv", self._rows)
        returns = result["eval_return"]
        rate = self.used.sum() / self.seconds
        self._display.evaluated(
            self._done(),
            int(self._update.max()),
            float(self.used.mean()),
            float(iqm(returns)),
            float(returns.min()),
            float(rate),
        )

    def _row(self, seed: int, result: dict[str, np.ndarray]) -> dict[str, Any]:
        def last(name):
            return self._last[name][seed].item() if self._last else ""

        return {
            "seed": seed,
            "update": int(self._update[seed]),
            "episodes": int(self._update[seed]) * self._config.episodes_per_update,
            "env_steps": int(self.used[seed]),
            "wall_seconds": round(self.seconds, 3),
            "train_return": last("episode_return"),
            "eval_return": result["eval_return"][seed].item(),
            "eval_return_stochastic": result["eval_return_stochastic"][seed].item(),
            "eval_length": result["eval_length"][seed].item(),
            "train_length": last("episode_length"),
            "entropy": last("entropy"),
            "gradient_norm": last("gradient_norm"),
            "simulated_steps": last("simulated_steps"),
            "nonfinite_episodes": last("nonfinite_episodes"),
            "skipped_update": last("skipped_update"),
        }

    def finish(self, compile_seconds: float) -> dict[str, Any]:
        """Writes the training returns, the summary and the picture; returns the summary."""
        seconds = self.seconds
        history = {
            name: np.stack([evaluation[name] for evaluation in self._evaluations])
            for name in ("eval_return", "env_steps", "episodes")
        }
        training = self._training_returns()
        write_bytes(self._directory / "returns.npz", report.to_npz(training))
        summary = {
            "env": self._config.env,
            "engine": self._engine,
            "num_seeds": self._config.num_seeds,
            **report.summarize(history, self._threshold),
            "env_steps": self.used.tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": seconds,
            "env_steps_per_second": float(self.used.sum() / seconds),
            "useful_step_fraction": float(self.used.sum() / max(self._simulated, 1.0)),
            "nonfinite": self._broken,
        }
        picture = report.draw_learning_curve(
            history,
            training,
            self._config.env,
            self._threshold,
            "episodes" if self._config.env_steps is None else "env_steps",
        )
        write_bytes(self._directory / "learning_curve.png", picture)
        write_json(self._directory / "summary.json", summary)
        return summary

    def _training_returns(self) -> dict[str, np.ndarray]:
        """Returns ``episode_return`` and the ``env_steps`` and ``episodes`` after it, [U, S]."""
        types = {"episode_return": np.float32, "env_steps": np.int64, "episodes": np.int64}
        return {
            name: np.concatenate(
                [np.zeros((0, self._config.num_seeds), kind)]
                + [block[name] for block in self._training]
            )
            for name, kind in types.items()
        }
