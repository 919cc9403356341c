"""Standard output and error of a command: they take everything, and XLA's log stays away."""

import io
import os
import sys
from typing import Any


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
