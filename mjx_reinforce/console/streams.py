"""Standard output and error of a command: what is written to them, and how wide."""

import io
import os
import sys
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
        # Python has None for a stream that was not open, and every print would fail.
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (stays open)
        elif type(stream) is io.TextIOWrapper:
            raw_stream = _Lossy(stream.fileno(), "w", closefd=False)
            lossy_stream = io.TextIOWrapper(
                io.BufferedWriter(raw_stream),
                stream.encoding,
                "backslashreplace",
                line_buffering=stream.line_buffering or stream.write_through,
            )
            setattr(sys, name, lossy_stream)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence_alarms() -> None:
    """Keeps XLA's log from the screen, for a command line; call it before JAX is imported.

    XLA logs, in red, that a long compilation may be a bug of its own. What really fails is raised
    as an exception. A level that the user sets in TF_CPP_MIN_LOG_LEVEL is kept.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def say(text: str, stream: TextIO) -> None:
    """Prints text: on a terminal its lines end between words, else they are whole, for grep."""
    from rich.console import Console

    console = Console(file=stream, emoji=False, markup=False, highlight=False)
    console.print(text, soft_wrap=not console.is_terminal)


def say_error(message: str) -> None:
    """Prints what is wrong to standard error, in one line."""
    say(f"error: {' '.join(message.split())}", sys.stderr)
