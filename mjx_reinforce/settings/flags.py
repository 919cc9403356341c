"""Reading a command line, and refusing in one line."""

import dataclasses
import functools
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from mjx_reinforce import envs
from mjx_reinforce.console.commands import COMMANDS, command
from mjx_reinforce.console.streams import accept_everything, say_error
from mjx_reinforce.engine.checks import fits, nearest, read_as, whole_number
from mjx_reinforce.files import FULL_ERRORS, expanded
from mjx_reinforce.registry import is_own
from mjx_reinforce.settings.config import flag, marked
from mjx_reinforce.settings.declare import Range
from mjx_reinforce.settings.defaults import PRESETS

Form = TypeVar("Form")

#: How values are read, in every command: as ``--over`` reads them.
_READERS = ConstructorRegistry()
#: What is read otherwise than tyro does -> its name in --help, and how.
_CONVERTERS: dict[Any, tuple[str, Callable[[str], Any]]] = {
    int: ("INT", whole_number),
    type(None): ("{None}", functools.partial(read_as, type(None))),
    Path: ("PATH", expanded),
}
#: Flags of layers.
_LAYERS = [flag(name) for name in marked(Range.LAYERS)]
#: What people call a flag that has another name.
_OTHER_NAMES = {"--distribution": "--policy"}


@_READERS.primitive_rule
def _reader(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Returns how a value is read, such as the number 1e6, None in any case, or a path with ~."""
    if kind.type not in _CONVERTERS:
        return None
    metavar, read = _CONVERTERS[kind.type]
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: fits(value, kind.type),
        str_from_instance=lambda value: [str(value)],
    )


def _spread(arguments: Sequence[str]) -> Iterator[str]:
    """Yields the words of a command line, layers as tyro reads them: 32,32 as 32 32, none as no."""
    # The flag whose values the words are, until the next one comes.
    name = ""
    for word in arguments:
        if word.startswith("--"):
            name = word.partition("=")[0].replace("_", "-")
        # Here also --hidden-sizes=32,32 falls into its words, as tyro takes several of them.
        if name in _LAYERS:
            yield from re.sub(r"[=,]|\bnone\b", " ", word, flags=re.IGNORECASE).split()
        else:
            yield word


def read_command_line(
    form: type[Form],
    arguments: Sequence[str],
    prog: str,
    description: str | None = None,
) -> Form:
    """Returns what a command line says; --help exits, and so does what tyro cannot read.

    Args:
      form: the dataclass that is filled in; its fields may be dataclasses.
      arguments: the flags and their values.
      prog: the name of the program, for --help.
      description: of the program, for --help; the docstring of the form if not given.

    Raises:
      ValueError: a word or a value is empty, which would be read as the current folder; or a flag
        has another name here.
    """
    # Such as --output "$OUT" where OUT is unset.
    if any(not word or re.fullmatch("--[^=]+=", word) for word in arguments):
        raise ValueError("a value on the command line is empty; is a variable of the shell unset?")
    for word in arguments:
        name = word.partition("=")[0]
        if name in _OTHER_NAMES:
            raise ValueError(f"no flag is called {name}: write {_OTHER_NAMES[name]}")
    _give_help(form)
    # Flags are called by a setting's name alone, not --run.env: the groups are for --help.
    options: dict[str, Any] = {"registry": _READERS, "config": (tyro.conf.OmitArgPrefixes,)}
    return tyro.cli(form, prog=prog, description=description, args=[*_spread(arguments)], **options)


def _give_help(form: type) -> None:
    """Gives the fields of a dataclass their docstrings as help, each as one paragraph.

    Tyro would end its lines where those of the docstrings end, and wrap them besides.
    """
    params = docstring_parser.parse_from_object(form).params
    descriptions = {param.arg_name: param.description or "" for param in params}
    for field in dataclasses.fields(form):
        if dataclasses.is_dataclass(field.default):
            _give_help(type(field.default))
        elif field.name in descriptions:
            help = " ".join(descriptions[field.name].split())
            # The mapping of a field cannot be written to, so the field gets another.
            field.metadata = MappingProxyType({**field.metadata, "help": help})


def about_word(word: str) -> str:
    """Returns the message about a word that is neither a flag nor its value, with the remedy."""
    if word in envs.names() or is_own(word):
        return f"{word!r} is a task: write {command('train')} --env {word}"
    nearest_name = nearest(word, [*envs.names(), *PRESETS, *COMMANDS])
    hint = f" Did you mean {nearest_name!r}?" if nearest_name else ""
    return f"no flag or command takes {word!r}.{hint} (See --help.)"


def cannot_load(error: Exception) -> str:
    """Returns what is said of a library that is broken, or finds no memory."""
    remedy = "see pip check, and ulimit -v where memory is short"
    return f"cannot load what this package needs ({error}); {remedy}"


def run_command(form: type[Form], name: str, do: Callable[[Form], object]) -> None:
    """Reads the command line of a command, does what it says, and exits if that fails.

    Bad input is one line and status 2, and Ctrl-C ends with 130.

    Args:
      form: the dataclass that is filled in; its docstring is the description.
      name: of the command.
      do: what it does.
    """
    # First of all: a message about bad input may have letters that the terminal has not.
    accept_everything()
    try:
        do(read_command_line(form, sys.argv[1:], command(name)))
    except (ValueError, OSError) as error:
        is_full = isinstance(error, OSError) and error.errno in FULL_ERRORS
        say_error(f"{error}{'; make room there' * is_full}")
        sys.exit(2)
    except (ImportError, MemoryError) as error:
        say_error(cannot_load(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
