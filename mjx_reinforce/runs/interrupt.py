"""Ctrl-C while a run trains."""

import signal
import threading
from collections.abc import Callable
from typing import Any


class Interrupt(threading.Event):
    """Is set by Ctrl-C, so that the run stops after the present block; a second one stops at once.

    It listens inside a ``with`` block.
    """

    def __init__(self, say: Callable[[str], None]):
        """Takes what shows a line to the user."""
        super().__init__()
        self._say = say

    def __enter__(self) -> "Interrupt":
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: Any) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: Any) -> None:
        del number, frame
        self.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._say("stopping after this block of updates; Ctrl-C again stops at once")
