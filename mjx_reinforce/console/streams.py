"""Standard output and error of a command: what is written to them, and how wide."""

import contextlib
import io
import os
import re
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TextIO


class _Lossy(io.FileIO):
    """A file that drops what its full disk or its closed pipe does not take."""

    def write(self, data: Any) -> int | None:
        """Writes bytes, if it can."""
        try:
            return super().write(data)
        except OSError:
            return len(data)


def accept_everything() -> None:
    """Makes standard output and error take every text.

    A character that they cannot encode becomes an escape: a path with an accent would else end a
    run on a terminal of ASCII. What goes into a closed pipe (``| head``), onto a full disk or into
    a stream that is not open (``>&-``) is dropped. Streams that a test or a notebook has put in
    their place drop nothing.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (stays open)
        elif type(stream) is io.TextIOWrapper:
            raw = _Lossy(stream.fileno(), "w", closefd=False)
            made = io.TextIOWrapper(
                io.BufferedWriter(raw),
                stream.encoding,
                "backslashreplace",
                line_buffering=stream.line_buffering or stream.write_through,
            )
            setattr(sys, name, made)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence_alarms() -> None:
    """Keeps XLA's log from the screen, for a command line; call it before JAX is imported.

    XLA logs, in red, that a long compilation may be a bug of its own. What really fails is raised
    as an exception. A level that the user sets in TF_CPP_MIN_LOG_LEVEL is kept.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


#: Columns where nobody knows how many there are.
_DEFAULT_WIDTH = 80
#: A terminal with fewer wraps by itself.
_LEAST_COLUMNS = 20


def wrapped(text: str, columns: int) -> str:
    """Returns text whose lines have at most so many columns, and whole words.

    An indented line is an entry of a list: where two spaces or more divide it, its second part
    stays a column.
    """
    return "\n".join(_wrapped_line(line, columns) for line in text.split("\n"))


def _wrapped_line(line: str, columns: int) -> str:
    entry = re.match(r" +(\S+(?: \S+)*  +)?", line)
    later = 0 if entry is None else len(entry[0]) + (0 if entry[1] else 2)
    return textwrap.fill(
        line,
        columns,
        subsequent_indent=" " * later,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )


def for_stream(text: str, stream: TextIO) -> str:
    """Returns text as a stream shows it: wrapped on a terminal, else as it is, to be searched."""
    return wrapped(text, columns_of(stream)) if stream.isatty() else text


def columns_of(stream: TextIO) -> int:
    """Returns how wide a stream is: what COLUMNS says, or its terminal, or else 80."""
    given = os.environ.get("COLUMNS", "")
    columns = int(given) if given.isdecimal() else 0
    if not columns and stream.isatty():
        columns = os.get_terminal_size(stream.fileno()).columns
    return max(columns or _DEFAULT_WIDTH, _LEAST_COLUMNS)


def say_error(message: str) -> None:
    """Prints what is wrong to standard error: one line, wrapped on a terminal."""
    text = f"error: {' '.join(message.split())}"
    print(for_stream(text, sys.stderr), file=sys.stderr)


#: Seconds between two signs.
_INTERVAL = 15.0


def to_screen(text: str) -> None:
    """Prints a line before there is a display; one that the screen does not take is lost."""
    with contextlib.suppress(OSError):
        print(text, flush=True)


@contextlib.contextmanager
def heartbeat(
    say: Callable[[str], None],
    what: str = "compiling",
    interval: float = _INTERVAL,
) -> Iterator[None]:
    """Says again and again, while its block runs, that it goes on.

    Args:
      say: shows a line.
      what: is done in it.
      interval: time between two lines (s).
    """
    ended, began = threading.Event(), time.perf_counter()

    def beat() -> None:
        while not ended.wait(interval):
            say(f"still {what}, {time.perf_counter() - began:.0f} s")

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
