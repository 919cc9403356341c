"""When a peer has trained for so many seconds: evaluations and what comes before do not count."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence


class Clock:
    """Seconds of training, of which those inside ``paused()`` are left out."""

    def __init__(self, read: Callable[[], float] = time.perf_counter):
        """Starts counting; ``read`` returns the time (s)."""
        self._read = read
        self._start = read()

    @property
    def seconds(self) -> float:
        """How long training has lasted (s)."""
        return self._read() - self._start

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Leaves out what happens inside."""
        before = self._read()
        try:
            yield
        finally:
            self._start += self._read() - before


class Budgets:
    """Seconds of training after which a peer is evaluated, each once, in order."""

    def __init__(self, seconds: Sequence[float]):
        """Takes the budgets (s), in any order."""
        self._left = sorted(seconds)

    @property
    def spent(self) -> bool:
        """Whether every budget was used up."""
        return not self._left

    def due(self, seconds: float) -> list[float]:
        """Returns the budgets that ``seconds`` of training have used up since the last call."""
        used = [budget for budget in self._left if budget <= seconds]
        self._left = self._left[len(used) :]
        return used
