"""Compiling what comes next while something else runs."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any


@dataclasses.dataclass
class Stopwatch:
    """Where the time of a sweep goes (s).

    compiling: with nothing trained beside it
    running: training and evaluating
    """

    compiling: float = 0.0
    running: float = 0.0

    def wait(self, compiled: Future) -> Any:
        """Returns a program, once it is compiled."""
        began = time.perf_counter()
        program = compiled.result()
        self.compiling += time.perf_counter() - began
        return program


def one_ahead(tasks: Sequence[Callable[[], Any]]) -> Iterator[Any]:
    """Yields the results of tasks in order; each begins when the one before is handed out."""
    waiting = [started(tasks[0])] if tasks else []
    for following in (*tasks[1:], None):
        result = waiting.pop().result()
        if following is not None:
            waiting.append(started(following))
        yield result


def started(task: Callable[[], Any]) -> Future:
    """Returns the result to come of a task, which begins in a thread of its own.

    Python waits for it before it exits: a compiler that is cut off there ends the process.
    """
    future: Future = Future()

    def work() -> None:
        try:
            future.set_result(task())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work).start()
    return future
