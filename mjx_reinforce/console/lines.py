"""Text for people, wrapped at words to the width of their terminal."""

import os
import sys
import textwrap
from typing import TextIO

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
    body = line.lstrip(" ")
    indent = len(line) - len(body)
    name, gap, _ = body.partition("  ")
    later = 0
    if indent and gap:
        later = indent + len(body) - len(body.removeprefix(name).lstrip(" "))
    elif indent:
        later = indent + 2
    return textwrap.fill(
        line,
        columns,
        subsequent_indent=" " * later,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
        drop_whitespace=True,
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
