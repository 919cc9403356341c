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
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_HERE = Path(__file__).resolve().parents[1]
#: Code that no user wrote: Python's, installed packages, and ours.
_LIBRARIES = (
    *(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib")),
    *(_HERE, (_HERE / "envs").resolve()),
)
#: Characters of somebody else's message that are shown.
_LENGTH = 300
#: How alike names are, as ``difflib`` counts, of which a third of the letters differ.
_ALIKE = 0.66
#: What every environment has.
_PARTS = ("reset", "step", "action_size")
_KINDS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "True or False"),
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    str: (str, "text"),
    type(None): (type(None), "None"),
}
#: How people write the values of kinds that have few.
_WORDS: dict[Any, dict[str, Any]] = {
    type(None): {"none": None},
    bool: {"true": True, "false": False},
}


class BadEnvironmentError(ValueError):
    """An environment's code does not do what an environment must."""


def require(holds: object, message: str) -> None:
    """Raises BadEnvironmentError unless something holds."""
    if not holds:
        raise BadEnvironmentError(message)


def explain(error: BaseException) -> str:
    """Returns in one line what was raised, and the last line of the user's own code before it.

    The messages of JAX and MuJoCo have many lines, of which the first ones say what is wrong.
    """
    message = " ".join(str(error).split())
    message = message if len(message) <= _LENGTH else f"{message[:_LENGTH]} ..."
    said = f"{type(error).__name__}: {message}" if message else type(error).__name__
    own = ""
    for frame in traceback.extract_tb(error.__traceback__):
        file = Path(frame.filename).resolve()
        if not frame.filename.startswith("<") and not any(map(file.is_relative_to, _LIBRARIES)):
            own = f" ({file.name}, line {frame.lineno})"
    return said + own


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
    if len(kinds := alternatives(kind)) > 1:
        return any(fits(value, each) for each in kinds)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return any(type(value) is type(each) and value == each for each in inner)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        kinds = inner[:1] * len(value) if inner[-1] is ... else inner
        return len(kinds) == len(value) and all(map(fits, value, kinds))
    if kind in (int, float) and isinstance(value, bool):
        return False
    expected = _KINDS[kind][0] if kind in _KINDS else kind
    return isinstance(value, expected) if isinstance(expected, type) else True


def alternatives(kind: object) -> tuple[Any, ...]:
    """Returns the annotations of a union, or the one that is given."""
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if union else (kind,)


def spoken_kind(kind: object) -> str:
    """Returns an annotation in words."""
    if len(kinds := alternatives(kind)) > 1:
        return " or ".join(map(spoken_kind, kinds))
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, inner))}"
    if origin is tuple and inner[-1] is ...:
        return f"a tuple, each entry {spoken_kind(inner[0])}"
    if origin is tuple:
        return f"({', '.join(map(spoken_kind, inner))})"
    return _KINDS[kind][1] if kind in _KINDS else getattr(kind, "__name__", str(kind))


def read_as(kind: Any, word: str) -> Any:
    """Returns a text as a value of an annotation, of a union the first that fits.

    Raises:
      ValueError: it is none.
    """
    if len(kinds := alternatives(kind)) > 1:
        for each in kinds:
            with contextlib.suppress(ValueError):
                return read_as(each, word)
        raise ValueError(word)
    if typing.get_origin(kind) is tuple:
        inner = typing.get_args(kind)[0]
        return tuple(read_as(inner, part) for part in word.split(",")) if word != "none" else ()
    if typing.get_origin(kind) is typing.Literal:
        words = {name: name for name in typing.get_args(kind)}
    elif kind in _WORDS:
        words, word = _WORDS[kind], word.lower()
    else:
        return whole_number(word) if kind is int else kind(word)
    if word not in words:
        raise ValueError(word)
    return words[word]


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raises ValueError for an object of another class.

    Args:
      name: what it is called, for the message.
      value: what the user gave.
      kind: the class.
      example: what to write instead.
    """
    if not isinstance(value, kind):
        what = getattr(value, "__name__", repr(value) if isinstance(value, str) else None)
        got = what or f"a {type(value).__name__}"
        raise ValueError(f"{name} must be of type {kind.__name__}, such as {example}, got {got}")


def changed_fields(settings: "DataclassInstance") -> str:
    """Returns the fields of a dataclass that have other values than their defaults, as code."""
    given = (
        f"{field.name}={value!r}"
        for field in dataclasses.fields(settings)
        if field.init and (value := getattr(settings, field.name)) != field.default
    )
    return ", ".join(given)


def whole_number(text: str) -> int:
    """Returns a whole number as people write it, such as 2000000, 2_000_000 or 2e6.

    Raises:
      ValueError: the text is no number, or one with a fraction, or of a hundred digits and more.
    """
    try:
        number = decimal.Decimal(text)
    except decimal.InvalidOperation:
        number = decimal.Decimal("nan")
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
        missing = [part for part in _PARTS if not hasattr(env, part)]
    except Exception as error:  # action_size may be a property, the user's code
        raise BadEnvironmentError(f"{name}.action_size fails: {explain(error)}") from error
    lacks = f"{name} is not an environment: it has no {', '.join(missing)}"
    require(not missing, f"{lacks}; mjx_reinforce.Environment says what one has")


def known_number(value: Any) -> float | None:
    """Returns a number, NaN for what is none, and None for one that is traced."""
    import jax.core  # here alone: commands that compute nothing do not wait for it

    if isinstance(value, jax.core.Tracer):
        return None
    try:
        return math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        return math.nan


def check_number(name: str, value: object, *, positive: bool = False, finite: bool = True) -> None:
    """Raises ValueError for what is no number, or one that is negative."""
    number = known_number(value)
    if number is None:
        return
    allowed = number > 0 if positive else number >= 0
    if not allowed or (finite and math.isinf(number)):
        kind = "positive" if positive else "0 or more"
        raise ValueError(f"{name} must be {kind}{' and finite' * finite}, got {value!r}")


def check_count(name: str, value: int, least: int = 1) -> None:
    """Raises ValueError for what is no whole number, or one that is less than ``least``."""
    check_type(name, value, int)
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def check_key(key: object) -> None:
    """Raises ValueError for what is no random key."""
    import jax

    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jax.numpy.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed or dtype == jax.numpy.uint32):
        raise ValueError(f"the key must be a random key, such as jax.random.key(0), got {key!r}")


def check_name(kind: str, name: str, known: Mapping[str, Any]) -> None:
    """Raises ValueError for a name that is not known, with the known ones and the nearest.

    Args:
      kind: what is named, for the message.
      name: what the user typed.
      known: the table.
    """
    if name in known:
        return
    near = nearest(name, known)
    hint = f" Did you mean {near!r}?" if near else ""
    raise ValueError(f"unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(known))}.")


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Returns the known name that somebody meant, whatever the case of the letters, if any is near.

    Args:
      name: what the user typed; a known name that contains it is near. A version, such as -v5,
        makes no two names alike.
      known: the names; of versions of one name the last is meant, unless the user typed another.
    """
    typed, versions = _plain(name), {}
    for each in sorted(known):
        versions.setdefault(_plain(each), []).append(each)
    inside = [each for each in versions if len(typed) > 2 and typed in each]
    near = difflib.get_close_matches(typed, inside or versions, n=1, cutoff=0 if inside else _ALIKE)
    return difflib.get_close_matches(name, versions[near[0]], n=1, cutoff=0)[0] if near else None


def _plain(name: str) -> str:
    """Returns a name in small letters, without the version of a task."""
    return re.sub(r"-v\d+$", "", name.lower())
