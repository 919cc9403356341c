"""The configurations of a grid: every combination of the values of its settings."""

import dataclasses
import itertools
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from mjx_reinforce.checks import whole_number
from mjx_reinforce.registry import check_name, nearest
from mjx_reinforce.runs.commands import command
from mjx_reinforce.runs.config import Config, check, flag
from mjx_reinforce.runs.hints import other_names
from mjx_reinforce.runs.relevance import check_read

#: Settings that a sweep has once, and why.
_ONCE = {
    "env": "its results are of one task; make a sweep for each",
    "num_seeds": "every configuration has as many seeds",
    "seed": "every configuration has the same seeds; raise --num-seeds",
    "stop_when_solved": "a run would end when others beside it are solved",
    "engine": "it changes no result but by rounding",
    "output": "it has one directory",
    "overwrite": "it has one directory",
    "resume": "it goes on as a whole",
    "checkpoint_every": "it is saved as a whole",
    "test_episodes": "it has no test",
    **dict.fromkeys(("tensorboard", "wandb", "jsonl"), "its rows are in results.csv"),
}

_EXAMPLE = "such as --over learning-rate 1e-3 1e-2"


def read_over(given: Sequence[Sequence[str]]) -> dict[str, list[Any]]:
    """Returns the values of each setting from ``--over NAME VALUE VALUE ...``, in that order.

    Args:
      given: the words after each ``--over``.

    Raises:
      ValueError: a setting does not exist or stands twice, or a value is not of its type.
    """
    hints = typing.get_type_hints(Config)
    over: dict[str, list[Any]] = {}
    for words in given:
        if not words:
            raise ValueError(f"--over needs a setting and its values, {_EXAMPLE}")
        name = words[0].removeprefix("--").replace("-", "_")
        if name not in hints:
            raise ValueError(_unknown(words[0].removeprefix("--"), hints))
        if name in over:
            raise ValueError(f"--over {words[0]} is given twice: put all values behind one of them")
        over[name] = [_value(name, word, hints[name]) for word in words[1:]]
    return over


def _unknown(word: str, names: Iterable[str]) -> str:
    """Returns the message about a word that is no setting."""
    meant = [flag[2:] for flag in other_names(f"--{word.replace('_', '-')}")]
    known = [_spoken(name) for name in names]
    near = next((each for each in meant if each in known), None) or nearest(word, known)
    hint = f" Did you mean {near!r}?" if near else ""
    return f"unknown setting {word!r} after --over.{hint} (--help all lists the settings.)"


def grid(over: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Returns every combination of the values; the last setting changes fastest."""
    return [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]


def check_over(base: Config, over: Mapping[str, Sequence[Any]]) -> None:
    """Raises ValueError for settings that cannot be swept, or values that make no choice."""
    if base.stop_when_solved:
        raise ValueError(
            "--stop-when-solved is not for sweeps: a run would end when others beside it are "
            "solved; leave it out"
        )
    for name in ("tensorboard", "wandb", "jsonl"):
        if getattr(base, name):
            raise ValueError(f"{flag(name)} logs a run; leave it out: a sweep writes results.csv")
    if not over:
        raise ValueError(
            f"nothing is swept: give --over a setting and its values, {_EXAMPLE}, or train one "
            f"configuration by {command('train')}"
        )
    for name, values in over.items():
        check_name("setting", name, {field.name: None for field in dataclasses.fields(Config)})
        if name in _ONCE:
            raise ValueError(f"a sweep cannot go over {_spoken(name)}: {_ONCE[name]}")
        if len(values) < 2:
            one = f"; for one value pass {flag(name)}" if values else f", {_EXAMPLE}"
            raise ValueError(f"--over {_spoken(name)} needs two values or more{one}")
        twice = [x for i, x in enumerate(values) if x in values[:i]]
        if twice:
            raise ValueError(f"--over {_spoken(name)} has the value {twice[0]} twice")


def configure(
    base: Config, configurations: Sequence[Mapping[str, Any]], given: Sequence[str] = ()
) -> list[Config]:
    """Returns the settings of each configuration.

    Args:
      base: what they share.
      configurations: the values of what is swept.
      given: settings of the base that the user chose.

    Raises:
      ValueError: the settings of a configuration make no sense; it does not read a setting that is
        swept; or none of them reads one that was given.
    """
    configs = [dataclasses.replace(base, **values) for values in configurations]
    for config, values in zip(configs, configurations, strict=True):
        check(config)
        _check_all_read(config, values)
    for name in set(given).difference(*configurations[:1]):
        idle = [error for config in configs if (error := _not_read(config, name))]
        if len(idle) == len(configs):
            raise idle[0]
    return configs


def _check_all_read(config: Config, names: Iterable[str]) -> None:
    """Raises ValueError if a configuration does not read a setting."""
    # They count as chosen by the user also where they are the default.
    check_read(config, dataclasses.replace(config, **dict.fromkeys(names, object())))


def _not_read(config: Config, name: str) -> ValueError | None:
    """Returns the error of a configuration that does not read a setting."""
    try:
        _check_all_read(config, [name])
    except ValueError as error:
        return error
    return None


def _spoken(name: str) -> str:
    return name.replace("_", "-")


def _value(name: str, word: str, hint: Any) -> Any:
    """Returns a word of the command line as a value of a setting's type."""
    kinds = typing.get_args(hint) if _is_union(hint) else (hint,)
    for kind in kinds:
        try:
            return _as(kind, word)
        except ValueError:
            continue
    spaces = "; write spaces between values" if "," in word else ""
    raise ValueError(
        f"--over {_spoken(name)} has the value {word!r}, which is no {_kind(kinds)}{spaces}"
    )


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def _as(kind: Any, word: str) -> Any:
    """Returns a word as a value of a type, or raises ValueError."""
    if kind is type(None):
        return {"none": None}[word.lower()] if word.lower() == "none" else _no(word)
    if kind is bool:
        words = {"true": True, "false": False}
        return words[word.lower()] if word.lower() in words else _no(word)
    if typing.get_origin(kind) is Literal:
        return word if word in typing.get_args(kind) else _no(word)
    if typing.get_origin(kind) is tuple:
        inner = typing.get_args(kind)[0]
        return tuple(_as(inner, part) for part in word.split(",")) if word != "none" else ()
    return whole_number(word) if kind is int else kind(word)


def _no(word: str) -> Any:
    raise ValueError(word)


def _kind(kinds: Sequence[Any]) -> str:
    names = {int: "whole number", float: "number", bool: "True or False", type(None): "None"}
    spoken = [
        " or ".join(typing.get_args(kind))
        if typing.get_origin(kind) is Literal
        else names.get(kind, "list of numbers such as 32,32 (or none)")
        for kind in kinds
    ]
    return " or ".join(spoken)
