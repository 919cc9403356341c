"""Settings that nothing would read are refused."""

import dataclasses
from collections.abc import Collection

from mjx_reinforce.settings.config import Config, flag, marked
from mjx_reinforce.settings.groups import Reader

#: What a policy reads, or not.
_POLICIES = (Reader.CONJUGATE_GRADIENTS, Reader.FREE_STD, Reader.STD, Reader.CONTINUOUS)


def is_read(name: str, config: Config) -> bool:
    """Returns whether anything reads a setting in a run."""
    return all(reader.holds(config) for reader in Reader if name in marked(reader))


def check_read(config: Config, given: Collection[str]) -> None:
    """Raises ValueError for settings that a user gave and that nothing would read.

    Args:
      config: the settings.
      given: the names of those that the user gave.
    """
    for reader in Reader:
        idle = [name for name in marked(reader) if name in given]
        if idle and not reader.holds(config):
            flags = " ".join(as_flag(name, getattr(config, name)) for name in idle)
            raise ValueError(
                f"{flags} would do nothing: only {reader.said} reads that; "
                f"{'leave it out' if len(idle) == 1 else 'leave them out'}, or choose {reader.said}"
            )


def check_read_by_policy(config: Config, default: Config, policy: str) -> None:
    """Raises ValueError for settings that a user changed and that the policy does not read.

    Args:
      config: the settings.
      default: those that hold where the user gave none.
      policy: the distribution that stands for ``auto``, which depends on the environment.
    """
    read = {name for reader in _POLICIES for name in marked(reader)}
    check_read(
        dataclasses.replace(config, policy=policy), read.intersection(changed(config, default))
    )


def changed(config: Config, default: Config) -> tuple[str, ...]:
    """Returns the names of the settings in which two differ."""
    names = (field.name for field in dataclasses.fields(Config))
    return tuple(name for name in names if getattr(config, name) != getattr(default, name))


def as_flag(name: str, value: object) -> str:
    """Returns a setting as it stands on the command line."""
    return " ".join(as_words(name, value))


def as_words(name: str, value: object) -> list[str]:
    """Returns the words of a setting on the command line; None, text, numbers or lists of them."""
    if isinstance(value, bool):
        return [flag(name if value else f"no_{name}")]
    return [flag(name), *map(str, value if isinstance(value, tuple | list) else (value,))]
