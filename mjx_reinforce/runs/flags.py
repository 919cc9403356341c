"""Reading a command line, and refusing in one line."""

import contextlib
import dataclasses
import difflib
import io
import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import tyro

#: Columns that --help is written for at least.
_LEAST_WIDTH = 60
#: What tyro says of a value that is not of its type -> what we say.
_PLAIN = {
    r"Error parsing (\S+): no type matching {None}\|INT .* from \['(.*?)'\].*": (
        r"\1 takes a whole number or None, got '\2'"
    ),
    r"Error parsing (\S+): no type matching {None}\|FLOAT .* from \['(.*?)'\].*": (
        r"\1 takes a number or None, got '\2'"
    ),
    r"Error parsing (\S+): Could not find valid parse for arguments: .*": (
        r"\1 takes whole numbers with spaces between them, such as 32 32"
    ),
}


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
        with contextlib.redirect_stderr(box), _room_for_help():
            parsed, unknown = tyro.cli(
                form, args=arguments, prog=prog, description=description, return_unknown_args=True
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(f"{_first_section(box.getvalue())} (see --help)") from stop
    if unknown:
        first = "a preset comes before all flags; " if prog.endswith("[PRESET]") else ""
        raise ValueError(_about_unknown(unknown, list(_flags(parsed)), first))
    return parsed


@contextlib.contextmanager
def _room_for_help() -> Iterator[None]:
    """Lets a narrow terminal wrap lines itself: of 20 columns tyro makes thousands of lines."""
    given = os.environ.get("COLUMNS")
    if shutil.get_terminal_size().columns < _LEAST_WIDTH:
        os.environ["COLUMNS"] = str(_LEAST_WIDTH)
    try:
        yield
    finally:
        if given is None:
            os.environ.pop("COLUMNS", None)
        else:
            os.environ["COLUMNS"] = given


def _flags(parsed: Any) -> Iterator[str]:
    """Yields the flags of a dataclass, and those of the dataclasses in it."""
    for field in dataclasses.fields(parsed):
        value = getattr(parsed, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flags(value)
        else:
            yield f"--{field.name.replace('_', '-')}"


def _about_unknown(unknown: Sequence[str], flags: Sequence[str], first: str) -> str:
    """Returns the message about what tyro could not place; ``first`` says what may come first."""
    flag = next((text.partition("=")[0] for text in unknown if text.startswith("-")), None)
    if flag is None:
        return f"no flag takes {' '.join(map(repr, unknown))} ({first}see --help)"
    if flag in flags:
        return f"{flag} stands after --, which ends the flags: leave -- out"
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
    text = " ".join(said)
    for pattern, replacement in _PLAIN.items():
        text = re.sub(pattern, replacement, text)
    return text


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Ends the program with one line and status 2 for bad input, with 130 after Ctrl-C."""
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
