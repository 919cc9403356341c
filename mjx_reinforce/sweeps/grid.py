"""The configurations of a grid: every combination of the values of its settings."""

import contextlib
import dataclasses
import itertools
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from mjx_reinforce.console.commands import command
from mjx_reinforce.engine.checks import alternatives, check_name, nearest, read_as
from mjx_reinforce.settings.config import Config, check, check_read, flag, spoken
from mjx_reinforce.settings.groups import LogSettings

_FIELDS = {field.name: field for field in dataclasses.fields(Config)}
#: What comes before the name of a setting of the environment, such as env_set.frame_skip.
_ENV_SET = "env_set."
#: Settings of an environment that all configurations of a sweep share, and why.
_ENV_ONCE = {
    "max_episode_steps": "--over horizon says how long episodes are",
    "reward_threshold": "its report has one return that counts as solved",
}
_EXAMPLE = "such as --over learning-rate 1e-3 1e-2"


def read_over(given: Sequence[Sequence[str]]) -> dict[str, list[Any]]:
    """Returns the values of each setting from ``--over NAME VALUE VALUE ...``, in that order.

    Args:
      given: the words after each ``--over``.

    Raises:
      ValueError: a setting does not exist or stands twice, or a value is not of its type.
    """
    over: dict[str, list[Any]] = {}
    for words in given:
        if not words:
            raise ValueError(f"--over needs a setting and its values, {_EXAMPLE}")
        name = words[0].removeprefix("--").replace("-", "_")
        if name not in _FIELDS and not _of_env(name):
            raise ValueError(_unknown(words[0].removeprefix("--")))
        if name in over:
            raise ValueError(f"--over {words[0]} is given twice: put all values behind one of them")
        over[name] = [_value(name, word) for word in words[1:]]
    return over


def _of_env(name: str) -> str | None:
    """Returns the setting of the environment that a name after --over means, if it is one."""
    own = name.removeprefix(_ENV_SET)
    return own if own != name and own.isidentifier() else None


def _unknown(word: str) -> str:
    """Returns the message about a word that is no setting."""
    near = nearest(word, [spoken(name) for name in _FIELDS])
    hint = f" Did you mean {near!r}?" if near else ""
    return f"unknown setting {word!r} after --over.{hint} (--help all lists the settings.)"


def grid(over: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Returns every combination of the values; the last setting changes fastest."""
    return [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]


def check_over(base: Config, over: Mapping[str, Sequence[Any]]) -> None:
    """Raises ValueError for settings that cannot be swept, or values that make no choice."""
    for field in dataclasses.fields(LogSettings):
        if getattr(base, field.name):
            raise ValueError(
                f"{flag(field.name)} logs a run; leave it out: a sweep writes results.csv"
            )
    if not over:
        raise ValueError(
            f"nothing is swept: give --over a setting and its values, {_EXAMPLE}, or train one "
            f"configuration by {command('train')}"
        )
    for name, values in over.items():
        if own := _of_env(name):
            why = _ENV_ONCE.get(own)
        else:
            check_name("setting", name, _FIELDS)
            why = _FIELDS[name].metadata.get("once")
        if why:
            raise ValueError(f"a sweep cannot go over {spoken(name)}: {why}")
        if len(values) < 2:
            passed = f"--env-set {own}={values[0]}" if own and values else flag(name)
            one = f"; for one value pass {passed}" if values else f", {_EXAMPLE}"
            raise ValueError(f"--over {spoken(name)} needs two values or more{one}")
        twice = [x for i, x in enumerate(values) if x in values[:i]]
        if twice:
            raise ValueError(f"--over {spoken(name)} has the value {twice[0]} twice")


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
    configs = [_with_values(base, values) for values in configurations]
    for config, values in zip(configs, configurations, strict=True):
        check(config)
        check_read(config, values)
    for name in set(given).difference(*configurations[:1]):
        idle = [error for config in configs if (error := _not_read(config, name))]
        if len(idle) == len(configs):
            raise idle[0]
    return configs


def _with_values(base: Config, values: Mapping[str, Any]) -> Config:
    """Returns settings with other values, also of settings of the environment."""
    plain = {name: value for name, value in values.items() if not _of_env(name)}
    config = dataclasses.replace(base, **plain)
    given = {own: f"{own}={value}" for name, value in values.items() if (own := _of_env(name))}
    if not given:
        return config
    kept = [word for word in config.env_set if word.partition("=")[0] not in given]
    return dataclasses.replace(config, env_set=(*kept, *given.values()))


def _not_read(config: Config, name: str) -> ValueError | None:
    """Returns the error of a configuration that does not read a setting."""
    try:
        check_read(config, [name])
    except ValueError as error:
        return error
    return None


def _value(name: str, word: str) -> Any:
    """Returns a word of the command line as a value of a setting's type.

    The environment reads its own settings; a range needs numbers.
    """
    kind = (int | float | str) if _of_env(name) else _FIELDS[name].type
    with contextlib.suppress(ValueError):
        return read_as(kind, word)
    spaces = "; write spaces between values" if "," in word else ""
    said = _kind(alternatives(kind))
    raise ValueError(f"--over {spoken(name)} has the value {word!r}, which is no {said}{spaces}")


def _kind(kinds: Sequence[Any]) -> str:
    names = {int: "whole number", float: "number", type(None): "None"}
    spoken = [
        " or ".join(typing.get_args(kind))
        if typing.get_origin(kind) is Literal
        else names.get(kind, "list of numbers such as 32,32 (or none)")
        for kind in kinds
    ]
    return " or ".join(spoken)
