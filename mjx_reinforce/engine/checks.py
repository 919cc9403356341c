"""Checks of what users give, and one line for what their code, or a library, raised."""

import contextlib
import dataclasses
import decimal
import difflib
import math
import numbers
import re
import sysconfig
import traceback
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_PACKAGE = Path(__file__).resolve().parents[1]
_PYTHON = (Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))
#: Code that no user wrote: Python's, installed packages, and ours.
_LIBRARIES = [path.resolve() for path in (*_PYTHON, _PACKAGE, _PACKAGE / "envs")]
#: Characters of somebody else's message that are shown.
_MAX_MESSAGE = 300
#: How alike names are, as ``difflib`` counts, of which a third of the letters differ.
_MIN_SIMILARITY = 0.66
#: The greatest of what an update counts, such as its env steps: they are int32.
MAX_OF_UPDATE = 2**31 - 1
#: What every environment has.
_MEMBERS = ("reset", "step", "action_size")


class _Kind(NamedTuple):
    """A kind of value: its class, and what messages call it."""

    type: Any
    words: str


_KINDS: dict[Any, _Kind] = {
    bool: _Kind(bool, "True or False"),
    int: _Kind(numbers.Integral, "a whole number"),
    float: _Kind(numbers.Real, "a number"),
    str: _Kind(str, "text"),
    type(None): _Kind(type(None), "None"),
}
#: How people write the values of kinds that have few.
_WORDS: dict[Any, dict[str, Any]] = {
    type(None): {"none": None},
    bool: {"true": True, "false": False},
}


class BadEnvironmentError(ValueError):
    """An environment's code does not do what an environment must."""


def require(condition: object, message: str) -> None:
    """Raises BadEnvironmentError unless something holds."""
    if not condition:
        raise BadEnvironmentError(message)


def explain(error: BaseException) -> str:
    """Returns in one line what was raised, and the last line of the user's own code before it.

    The messages of JAX and MuJoCo have many lines, of which the first ones say what is wrong.
    """
    message = " ".join(str(error).split())
    if len(message) > _MAX_MESSAGE:
        message = f"{message[:_MAX_MESSAGE]} ..."
    summary = type(error).__name__
    if message:
        summary = f"{summary}: {message}"
    # Frames go from the outermost to where it was raised: the user's last one is the nearest.
    user_line = ""
    for frame in traceback.extract_tb(error.__traceback__):
        file = Path(frame.filename).resolve()
        # Code without a file, such as what dataclasses write, is "<string>".
        if not frame.filename.startswith("<") and not any(map(file.is_relative_to, _LIBRARIES)):
            user_line = f" ({file.name}, line {frame.lineno})"
    return summary + user_line


def check_type(name: str, value: object, kind: object) -> None:
    """Raises ValueError for a value that is not of its annotation.

    Args:
      name: what it is called, for the message.
      value: what the user gave.
      kind: the annotation. Of those that are neither numbers, text, None, Literal, tuples nor
        unions of these, only classes are checked.
    """
    if not fits(value, kind):
        raise ValueError(f"{name} must be {spoken_kind(kind)}, got {value!r}")


def fits(value: object, kind: object) -> bool:
    """Returns whether a value is of an annotation, see ``check_type``."""
    kinds = alternatives(kind)
    if len(kinds) > 1:
        return any(fits(value, member) for member in kinds)
    origin = typing.get_origin(kind)
    arguments = typing.get_args(kind)
    if origin is typing.Literal:
        # By type too, since 1 == True == 1.0.
        return any(type(value) is type(literal) and value == literal for literal in arguments)
    if origin is tuple:
        return _fits_tuple(value, arguments)
    # Python's bool is an int; a setting that is a number is not to be True.
    if kind in (int, float) and isinstance(value, bool):
        return False
    allowed_type = _KINDS[kind].type if kind in _KINDS else kind
    return not isinstance(allowed_type, type) or isinstance(value, allowed_type)


def _fits_tuple(value: object, arguments: tuple[Any, ...]) -> bool:
    """Returns whether a value is a tuple of these kinds, or, as in TOML and JSON, a list."""
    if not isinstance(value, tuple | list):
        return False
    if arguments[-1] is ...:
        arguments = arguments[:1] * len(value)
    return len(arguments) == len(value) and all(map(fits, value, arguments))


def alternatives(kind: object) -> tuple[Any, ...]:
    """Returns the annotations of a union, or of what is no union the annotation alone."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return typing.get_args(kind)
    return (kind,)


def spoken_kind(kind: object) -> str:
    """Returns an annotation in words."""
    kinds = alternatives(kind)
    if len(kinds) > 1:
        return " or ".join(map(spoken_kind, kinds))
    origin = typing.get_origin(kind)
    arguments = typing.get_args(kind)
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if origin is tuple and arguments[-1] is ...:
        return f"a tuple, each entry {spoken_kind(arguments[0])}"
    if origin is tuple:
        return f"({', '.join(map(spoken_kind, arguments))})"
    if kind in _KINDS:
        return _KINDS[kind].words
    return getattr(kind, "__name__", str(kind))


def read_as(kind: Any, word: str) -> Any:
    """Returns a text as a value of an annotation, of a union the first that fits.

    Raises:
      ValueError: it is none.
    """
    kinds = alternatives(kind)
    if len(kinds) > 1:
        for member in kinds:
            with contextlib.suppress(ValueError):
                return read_as(member, word)
        raise ValueError(word)
    if typing.get_origin(kind) is tuple:
        entry_kind = typing.get_args(kind)[0]
        if word == "none":  # how a command line writes an empty tuple
            return ()
        return tuple(read_as(entry_kind, entry) for entry in word.split(","))
    if kind is int:
        return whole_number(word)
    if typing.get_origin(kind) is typing.Literal:
        values = {name: name for name in typing.get_args(kind)}
    elif kind in _WORDS:
        values = _WORDS[kind]
        word = word.lower()
    else:
        return kind(word)
    if word not in values:
        raise ValueError(word)
    return values[word]


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raises ValueError for an object of another class.

    Args:
      name: what it is called, for the message.
      value: what the user gave.
      kind: the class.
      example: what to write instead.
    """
    if isinstance(value, kind):
        return
    # A class or function by its name, a text as it is, anything else by its type.
    description = getattr(value, "__name__", "")
    if isinstance(value, str):
        description = description or repr(value)
    description = description or f"a {type(value).__name__}"
    raise ValueError(
        f"{name} must be of type {kind.__name__}, such as {example}, got {description}"
    )


def changed_fields(settings: "DataclassInstance") -> str:
    """Returns the fields of a dataclass that have other values than their defaults, as code."""
    arguments = []
    for field in dataclasses.fields(settings):
        if not field.init:
            continue
        value = getattr(settings, field.name)
        if value != field.default:
            arguments.append(f"{field.name}={value!r}")
    return ", ".join(arguments)


def whole_number(text: str) -> int:
    """Returns a whole number as people write it, such as 2000000, 2_000_000 or 2e6.

    Raises:
      ValueError: the text is no number, or one with a fraction, or of a hundred digits and more.
    """
    try:
        number = decimal.Decimal(text)
    except decimal.InvalidOperation:
        number = decimal.Decimal("nan")
    # Its size before its value: int would write out all the digits of 1e999999999.
    if not number.is_finite() or number.adjusted() >= 100 or number != int(number):
        raise ValueError(f"takes a whole number, such as 4 or 2e6, got {text!r}")
    return int(number)


def is_nan(value: object) -> bool:
    """Returns whether a value is a number that is none."""
    return isinstance(value, numbers.Real) and math.isnan(value)


def check_parts(env: object) -> None:
    """Raises ValueError for an object that has not the methods of an environment."""
    name = type(env).__name__
    if isinstance(env, type):
        raise BadEnvironmentError(f"{env.__name__} is a class, not an environment yet: call it")
    try:
        missing_members = [member for member in _MEMBERS if not hasattr(env, member)]
    except Exception as error:  # action_size may be a property, the user's code
        raise BadEnvironmentError(f"{name}.action_size fails: {explain(error)}") from error
    complaint = f"{name} is not an environment: it has no {', '.join(missing_members)}"
    require(not missing_members, f"{complaint}; mjx_reinforce.Environment says what one has")


def known_number(value: Any) -> float | None:
    """Returns a number, NaN for what is none, and None for one that is traced."""
    import jax.core  # here alone: commands that compute nothing do not wait for it

    if isinstance(value, jax.core.Tracer):
        return None
    if isinstance(value, bool | str):  # of both, float would make numbers
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def check_number(name: str, value: object, *, positive: bool = False, finite: bool = True) -> None:
    """Raises ValueError for what is no number, or one that is negative."""
    number = known_number(value)
    if number is None:
        return
    # Comparisons with NaN are False: it is not allowed.
    is_allowed = number > 0 if positive else number >= 0
    if is_allowed and not (finite and math.isinf(number)):
        return
    kind = "positive" if positive else "0 or more"
    if finite:
        kind = f"{kind} and finite"
    raise ValueError(f"{name} must be {kind}, got {value!r}")


def check_count(name: str, value: int, minimum: int = 1) -> None:
    """Raises ValueError for what is no whole number, or not from ``minimum`` to 2^31 - 1."""
    check_type(name, value, int)
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value}")
    if value > MAX_OF_UPDATE:
        raise ValueError(f"{name} must be less than 2^31, got {value}")


def check_key(key: object) -> None:
    """Raises ValueError for what is no random key."""
    import jax

    dtype = getattr(key, "dtype", None)
    is_typed = dtype is not None and jax.numpy.issubdtype(dtype, jax.dtypes.prng_key)
    if not (is_typed or dtype == jax.numpy.uint32):
        raise ValueError(f"the key must be a random key, such as jax.random.key(0), got {key!r}")


def check_name(kind: str, name: str, choices: Mapping[str, Any]) -> None:
    """Raises ValueError for a name that is not in a table, with its names and the nearest of them.

    Args:
      kind: what is named, for the message.
      name: what the user typed.
      choices: has the names.
    """
    if name in choices:
        return
    nearest_name = nearest(name, choices)
    hint = f" Did you mean {nearest_name!r}?" if nearest_name else ""
    raise ValueError(f"unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(choices))}.")


def nearest(name: str, choices: Iterable[str]) -> str | None:
    """Returns the name that somebody meant, whatever the case of the letters, if any is near.

    Args:
      name: what the user typed; a name that contains it is near. A version, such as -v5, makes no
        two names alike.
      choices: of versions of one name the last is meant, unless the user typed another.
    """
    query = _plain(name)
    versions: dict[str, list[str]] = {}
    for candidate in sorted(choices):
        versions.setdefault(_plain(candidate), []).append(candidate)
    # Of names that hold what was typed the most alike is meant, however much longer it is.
    supernames = [plain_name for plain_name in versions if len(query) > 2 and query in plain_name]
    if supernames:
        matches = difflib.get_close_matches(query, supernames, n=1, cutoff=0)
    else:
        matches = difflib.get_close_matches(query, versions, n=1, cutoff=_MIN_SIMILARITY)
    if not matches:
        return None
    return difflib.get_close_matches(name, versions[matches[0]], n=1, cutoff=0)[0]


def _plain(name: str) -> str:
    """Returns a name in small letters, without the version of a task."""
    return re.sub(r"-v\d+$", "", name.lower())
