"""How much of its budget a run has used, and when the next checkpoint is due."""

import time

import numpy as np

from mjx_reinforce.settings.config import Config

#: Between checkpoints, where the user has not said how many updates.
_CHECKPOINT_SECONDS = 60.0


def used(config: Config, env_steps: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns the fraction of its budget that each seed has used, of counts [..., S]."""
    fraction = np.zeros(env_steps.shape)
    if config.env_steps is not None:
        fraction = env_steps / config.env_steps
    if config.max_updates is not None:
        fraction = np.maximum(fraction, updates / config.max_updates)
    return fraction


class SaveDue:
    """When a checkpoint is due: after enough updates, or about a minute after the last one."""

    def __init__(self, checkpoint_every: int | None):
        """Begins before the first update.

        Args:
          checkpoint_every: updates between checkpoints; None for about a minute.
        """
        self._every = checkpoint_every
        self.saved(0)

    def saved(self, updates: int) -> None:
        """Notes that the newest checkpoint has so many updates, also one that was found."""
        self._at, self._updates = time.perf_counter(), updates

    def is_due(self, updates: int) -> bool:
        """Returns whether to save after so many updates."""
        if self._every is None:
            return time.perf_counter() - self._at >= _CHECKPOINT_SECONDS
        return updates - self._updates >= self._every


def not_written(what: str, error: OSError) -> str:
    """Returns the warning that a file of a run that goes on cannot be written."""
    problem = error.strerror or error
    return f"warning: cannot write {what} ({problem}); training goes on and tries again"
