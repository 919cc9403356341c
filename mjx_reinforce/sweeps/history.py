"""What the runs of a chunk have measured so far: evaluations, and what was used until then.

Nothing here prints, writes a file, or reads a clock.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.progress import Progress, measure_progress, used
from mjx_reinforce.training.record import GrowingTable

#: What is kept of every evaluation, and the name of its latest.
_CURVES = {"eval_return": "eval_return", "env_steps": "eval_env_steps"}


class Measured(NamedTuple):
    """One evaluation of some runs, and the block of updates after it.

    runs: [n] their numbers
    values: [n] each: ``eval_return``, and ``eval_steps``, those of all its episodes; of runs that
      then made updates also ``updates`` and ``env_steps`` since the start, and ``nonfinite``, how
      many updates of the block met numbers that are not finite
    """

    runs: np.ndarray
    values: Arrays


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
