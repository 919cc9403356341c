"""Signs of life of what takes long, for those who have no terminal."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

#: Seconds between two signs.
_INTERVAL = 15.0


def to_screen(text: str) -> None:
    """Prints a line before there is a display; one that the screen does not take is lost."""
    with contextlib.suppress(OSError):
        print(text, flush=True)


@contextlib.contextmanager
def heartbeat(
    say: Callable[[str], None],
    expected: float | None,
    what: str = "compiling",
    interval: float = _INTERVAL,
) -> Iterator[None]:
    """Says again and again, while its block runs, that it goes on.

    Args:
      say: shows a line.
      expected: how long the block takes (s), or None if that is not known.
      what: is done in it.
      interval: time between two lines (s).
    """
    ended, began = threading.Event(), time.perf_counter()

    def beat() -> None:
        while not ended.wait(interval):
            passed = time.perf_counter() - began
            known = expected is not None and passed < expected
            outlook = f"; about {expected:.0f} s expected" if known else ""
            say(f"still {what}, {passed:.0f} s{outlook}")

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
