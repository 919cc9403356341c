"""A sign of life while a program compiles, for those who have no terminal."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

#: Seconds between two signs.
_INTERVAL = 15.0


@contextlib.contextmanager
def heartbeat(
    say: Callable[[str], None], expected: float | None, interval: float = _INTERVAL
) -> Iterator[None]:
    """Says again and again, while its block runs, that compiling goes on.

    Args:
      say: shows a line.
      expected: how long the block takes (s), or None if that is not known.
      interval: time between two lines (s).
    """
    ended, began = threading.Event(), time.perf_counter()
    outlook = "" if expected is None else f"; about {expected:.0f} s expected"

    def beat() -> None:
        while not ended.wait(interval):
            say(f"still compiling, {time.perf_counter() - began:.0f} s{outlook}")

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
