"""When the files of runs that go on are written, and that they can be written again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import remove_parts, write_json
from mjx_reinforce.training.checkpoint import Attempts, Checkpoint, SaveDue
from mjx_reinforce.training.driver import Observer, Seen


class Files(Observer[Seen]):
    """The files of a run or a sweep in its directory.

    A checkpoint that cannot be written while runs go on is a warning, and is tried again.

    contents: what the first file says
    """

    #: Folders in which files are written, beside the directory itself.
    _folders: tuple[str, ...] = ()

    def __init__(self, directory: Path, contents: dict[str, Any], say: Callable[[str], None]):
        """Takes the files before they are there.

        Args:
          directory: where they are.
          contents: what the first file says.
          say: shows a line to the user.
        """
        self._directory, self.contents, self._say = directory, contents, say
        self._attempt = Attempts(say).attempt
        self._due = SaveDue(None)
        #: Whether the newest checkpoint is of the present state.
        self._saved = False

    def open(self) -> None:
        """Removes what a crash left of writing files."""
        remove_parts(self._directory, *(self._directory / name for name in self._folders))

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of this name have ended."""
        return False

    def updated(self, driver: Seen, met: np.ndarray) -> None:
        """Saves if that is due; the last block is saved with its evaluation, by ``ended``."""
        self._saved = False
        if not driver.record.finished() and self._due.is_due(driver.updates()):
            self._save(driver)

    def ended(self, driver: Seen) -> None:
        """Saves the last state, unless it is saved; tries twice if a checkpoint is due."""
        if self._due.is_due(driver.updates()):
            self._save(driver)
        if not self._saved:
            self._save(driver)

    def _go_on(self, driver: Seen, found: Checkpoint | None) -> None:
        """Takes runs to a checkpoint, if there is one, from where the next is due."""
        if found is not None:
            driver.restore(found)
        self._saved = found is not None
        self._due = SaveDue(driver.config.checkpoint_every)
        self._due.saved(driver.updates())

    def _save(self, driver: Seen) -> None:
        """Writes a checkpoint, in case the runs are killed."""
        self._due.saved(driver.updates())
        self._saved = self._attempt("a checkpoint", lambda: self._save_checkpoint(driver))

    def _save_checkpoint(self, driver: Seen) -> None:
        """Writes a checkpoint, or raises OSError."""
        raise NotImplementedError

    def _write_json(self, name: str, content: dict[str, Any]) -> None:
        write_json(self._directory / name, content)
