"""When a checkpoint is due, and what is done where a file cannot be written while a run goes on."""

import time
from collections.abc import Callable

#: Between checkpoints, where the user has not said how many updates.
_CHECKPOINT_SECONDS = 60.0


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


class Attempts:
    """Writes of a run that goes on: one that fails is a warning, and is tried again later."""

    def __init__(self, say: Callable[[str], None]):
        """Takes what shows a line to the user."""
        self._say = say
        self._failing: set[str] = set()

    def attempt(self, what: str, write: Callable[[], None]) -> bool:
        """Returns whether something could be written; the first failure in a row is shown.

        Args:
          what: is written, for the warning.
          write: writes it, or raises OSError.
        """
        try:
            write()
            self._failing.discard(what)
            return True
        except OSError as error:
            if what not in self._failing:
                problem = error.strerror or error
                self._say(
                    f"warning: cannot write {what} ({problem}); training goes on and tries again"
                )
            self._failing.add(what)
            return False
