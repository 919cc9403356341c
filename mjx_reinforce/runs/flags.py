"""Reading a command line, and writing to terminals that lack some characters."""

import contextlib
import dataclasses
import difflib
import io
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import tyro


def read(form: Any, arguments: Sequence[str], prog: str, description: str) -> Any:
    """Returns what a command line says; --help exits.

    Args:
      form: the dataclass that is filled in.
      arguments: the flags and their values.
      prog: the name of the program, for --help.
      description: of the program, for --help.

    Raises:
      ValueError: a flag is unknown, or its value is not of its type; in one line, where tyro
        prints a box of a dozen.
    """
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            parsed, unknown = tyro.cli(
                form, args=arguments, prog=prog, description=description, return_unknown_args=True
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(f"{_first_section(box.getvalue())} (see --help)") from stop
    if unknown:
        raise ValueError(_about_unknown(unknown, list(_flags(parsed))))
    return parsed


def _flags(parsed: Any) -> Iterator[str]:
    """Yields the flags of a dataclass, and those of the dataclasses in it."""
    for field in dataclasses.fields(parsed):
        value = getattr(parsed, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flags(value)
        else:
            yield f"--{field.name.replace('_', '-')}"


def _about_unknown(unknown: Sequence[str], flags: Sequence[str]) -> str:
    """Returns the message about what tyro could not place."""
    flag = next((text.partition("=")[0] for text in unknown if text.startswith("-")), None)
    if flag is None:
        return f"no flag takes {' '.join(map(repr, unknown))} (see --help)"
    near = difflib.get_close_matches(flag, flags, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"unknown flag {flag!r}.{hint} (See --help.)"


def _first_section(box: str) -> str:
    """Returns the first paragraph of a message of tyro's, without its frame and title."""
    lines = [line.strip("│ ") for line in box.splitlines()[1:]]
    said: list[str] = []
    for line in lines:
        if line and not line.strip("─-╭╮╰╯"):
            if said:
                break
        else:
            said.append(line)
    return " ".join(said)


def accept_all_characters() -> None:
    """Makes standard output and error write an escape for a character that they cannot encode.

    A path with an accent would else end a run in a UnicodeEncodeError on a terminal of ASCII.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
