"""Reading a command line, and refusing in one line."""

import contextlib
import dataclasses
import inspect
import io
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TextIO, TypeVar, get_args, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from mjx_reinforce import envs
from mjx_reinforce.console.commands import COMMANDS, command
from mjx_reinforce.console.streams import accept_everything, columns_of, say_error, wrapped
from mjx_reinforce.engine.checks import nearest, whole_number
from mjx_reinforce.registry import is_own
from mjx_reinforce.settings.config import flag, spoken
from mjx_reinforce.settings.tables import PRESETS

Form = TypeVar("Form")

#: Columns that --help is written for at least: of 20 columns tyro makes thousands of lines.
_LEAST_WIDTH = 60
#: What tyro says of a value -> what we say, where that is clearer.
_OUR_WORDS = {
    r"\{None\}\||'None', |, 'None'": "",  # who leaves a flag out means that
    r"Error parsing (PATH|\[.*\]): .*": "'' is no path",  # without a flag
    r"Could not find valid parse for arguments: \[(.*)\]": (
        r"takes numbers with spaces between them, such as 32 32, got \1"
    ),
    r"no type matching (.+?) could .*?\[(.*?)\]\..*": r"takes \1, got \2",
    r"Error parsing (\S+):": r"\1",
}
#: How numbers and paths are read, everywhere.
_READERS = ConstructorRegistry()


@_READERS.primitive_rule
def _reader(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Returns how a number or a path is read: 1e6 is a whole number, and "" is no path."""
    readers = {
        int: ("INT", whole_number),
        float: ("FLOAT", _real_number),
        Path: ("PATH", _read_path),
    }
    if kind.type not in readers:
        return None
    metavar, reader = readers[kind.type]
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: reader(words[0]),
        is_instance=lambda value: isinstance(value, kind.type),
        str_from_instance=lambda value: [str(value)],
    )


def _real_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"takes a number, such as 0.5, got {text!r}") from None


def _read_path(text: str) -> Path:
    if not text:
        raise ValueError("takes a path, got ''")
    return Path(text)


def read_command_line(
    form: type[Form],
    arguments: Sequence[str],
    prog: str,
    description: str,
    main: Sequence[str] = (),
) -> Form:
    """Returns what a command line says; --help exits.

    Args:
      form: the dataclass that is filled in; its fields may be dataclasses.
      arguments: the flags and their values.
      prog: the name of the program, for --help.
      description: of the program, for --help.
      main: the fields that --help alone shows, where --help all shows all; all if not given.

    Raises:
      ValueError: a flag is unknown, or its value is not of its type; in one line, where tyro
        prints a box of a dozen.
    """
    box, page = io.StringIO(), _Page(sys.stdout)
    brief = bool(main) and asks_brief_help(arguments)
    asked = _few_fields(form, main) if brief else _with_help(form)
    options: dict[str, Any] = {"prog": prog, "description": "", "registry": _READERS}
    options["config"] = (tyro.conf.OmitArgPrefixes,)
    try:
        with _room_for_help(), contextlib.redirect_stdout(page), contextlib.redirect_stderr(box):
            parsed, unknown = tyro.cli(asked, args=arguments, return_unknown_args=True, **options)
    except SystemExit as stop:
        if not stop.code:
            print(_with_description(page.getvalue(), description), end="")
            if brief:
                print(f"\n--help all shows all {len(_names(form))} settings.")
            raise
        text = _first_section(box.getvalue())
        if text.startswith("Missing from"):
            text = f"{prog} needs {_required(form)}"
        for pattern, replacement in _OUR_WORDS.items():
            text = re.sub(pattern, replacement, text)
        raise ValueError(f"{text} (see --help)") from stop
    if unknown:
        raise ValueError(_about_unknown(unknown[0], form))
    return _as_form(form, parsed)


def asks_brief_help(arguments: Sequence[str]) -> bool:
    """Returns whether a command line asks for --help, and not for --help all."""
    after = [(*arguments, "")[i + 1] for i, x in enumerate(arguments) if x in ("-h", "--help")]
    return bool(after) and "all" not in after


class _Page(io.StringIO):
    """Text that is laid out for a stream on which it is printed later."""

    def __init__(self, stream: TextIO):
        super().__init__()
        self._stream = stream

    @property
    def encoding(self) -> str:
        """Returns that of the stream, which may have no frames."""
        return self._stream.encoding

    def isatty(self) -> bool:
        """Returns whether the stream shows colours."""
        return self._stream.isatty()


@contextlib.contextmanager
def _room_for_help() -> Iterator[None]:
    """Lets a terminal that is narrower than ``_LEAST_WIDTH`` wrap lines itself."""
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


def _with_help(form: type) -> type:
    """Returns a dataclass like another whose fields say their help in one paragraph.

    Tyro would end its lines where those of the docstrings end, and wrap them besides.
    """
    said = {
        x.arg_name: x.description or "" for x in docstring_parser.parse_from_object(form).params
    }
    hints, made = get_type_hints(form, include_extras=True), []
    for field in dataclasses.fields(form):
        kind, default = hints[field.name], field.default
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            kind = _with_help(kind)
            default = kind(**vars(default))
        elif field.name in said:
            kind = Annotated[kind, tyro.conf.arg(help=" ".join(said[field.name].split()))]
        made.append((field.name, kind, dataclasses.field(default=default)))
    return dataclasses.make_dataclass(
        form.__name__, made, frozen=True, kw_only=True, namespace={"__doc__": form.__doc__}
    )


def _few_fields(form: type, names: Sequence[str]) -> type:
    """Returns a dataclass with a few fields of the dataclasses in another, for --help."""
    groups = [field.default for field in dataclasses.fields(_with_help(form))]
    hints = {
        name: (kind, getattr(group, name))
        for group in groups
        for name, kind in get_type_hints(type(group), include_extras=True).items()
    }
    made = [(name, hints[name][0], dataclasses.field(default=hints[name][1])) for name in names]
    return dataclasses.make_dataclass(form.__name__, made, frozen=True, kw_only=True)


def _as_form(form: type[Form], parsed: object) -> Form:
    """Returns what was read as the dataclass that was asked for."""
    hints = get_type_hints(form)
    values = {
        name: _as_form(hints[name], value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(parsed).items()
    }
    return form(**values)


def _with_description(page: str, description: str) -> str:
    """Returns tyro's help with a description after its first line, which says the usage."""
    usage, _, rest = page.partition("\n\n")
    columns = max(columns_of(sys.stdout), _LEAST_WIDTH)
    return "\n\n".join([usage, wrapped(description, columns), rest])


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


def _names(form: type) -> list[str]:
    """Returns the settings of a dataclass, and of the dataclasses in it."""
    hints, names = get_type_hints(form), []
    for field in dataclasses.fields(form):
        kind = hints[field.name]
        inside = isinstance(kind, type) and dataclasses.is_dataclass(kind)
        names += _names(kind) if inside else [field.name]
    return names


def _required(form: type) -> str:
    """Returns what a command line must have, as --help calls it."""
    hints = get_type_hints(form, include_extras=True)
    needed = (f.name for f in dataclasses.fields(form) if f.default is dataclasses.MISSING)
    alone = {name for name, kind in hints.items() if tyro.conf.Positional in get_args(kind)}
    return " and ".join(name.upper() if name in alone else flag(name) for name in needed)


def _about_unknown(word: str, form: type) -> str:
    """Returns the message about a word that a form does not take."""
    if not word.startswith("-"):
        return about_word(word)
    name, known = word.partition("=")[0], [*map(spoken, _names(form))]
    if name.removeprefix("--") in known:
        return f"{name} stands after --, which ends the flags: leave -- out"
    near = nearest(spoken(name.lstrip("-")), known)
    hint = f" Did you mean '--{near}'?" if near else ""
    return f"unknown flag {name!r}.{hint} (See --help.)"


def about_word(word: str) -> str:
    """Returns the message about a word that is neither a flag nor its value, with the remedy."""
    if word in envs.names() or is_own(word):
        return f"{word!r} is a task: write {command('train')} --env {word}"
    if word in COMMANDS:
        return f"{word!r} is a command of its own, {command(word)}, and comes before all flags"
    if word in PRESETS:
        return f"{word!r} is a preset, and a preset comes before all flags (see --help)"
    near = nearest(word, [*envs.names(), *PRESETS, *COMMANDS])
    hint = f" Did you mean {near!r}?" if near else ""
    return f"no flag or command takes {word!r}.{hint} (See --help.)"


def run_command(form: type[Form], name: str, do: Callable[[Form], object]) -> None:
    """Reads the command line of a command, does what it says, and exits if that fails.

    Bad input is one line and status 2, and Ctrl-C ends with 130.

    Args:
      form: the dataclass that is filled in; its docstring is the description.
      name: of the command.
      do: what it does.
    """
    accept_everything()
    try:
        about = inspect.cleandoc(form.__doc__ or "")
        do(read_command_line(form, sys.argv[1:], command(name), about))
    except (ValueError, OSError) as error:
        say_error(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
