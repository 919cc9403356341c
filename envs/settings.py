"""The arguments of an environment: a frozen dataclass, nested in the class as ``Settings``.

Each argument stands once, with its default, unit and check, in the class that reads it; a task's
``Settings`` inherits from that of the task's base and changes defaults or adds fields.
"""

import dataclasses
import typing
from collections.abc import Sequence
from typing import Any

from mjx_reinforce.engine import checks

#: A range (low, high), of which ``EpisodeSettings`` checks that it contains something.
Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EpisodeSettings:
    """What every environment has."""

    max_episode_steps: int
    """The time limit (env steps); the trainer applies it."""
    reward_threshold: float | None
    """The return at which the task counts as solved; None if there is no such return."""

    def __post_init__(self):
        """Raises ValueError for a value that is out of its range."""
        checks.check_count("max_episode_steps", self.max_episode_steps)
        for field in dataclasses.fields(self):
            # The same object: other pairs of numbers may be of any order.
            if field.type is Interval:
                low, high = bounds = getattr(self, field.name)
                if not low < high:
                    raise ValueError(
                        f"{field.name} must be (low, high) with low < high, got {bounds}"
                    )


def build_settings(env: Any, arguments: dict[str, Any]) -> Any:
    """Returns the settings of an environment's class.

    Args:
      env: the environment; its class has the dataclass ``Settings``.
      arguments: the keyword arguments of its constructor.

    Raises:
      ValueError: an argument is unknown or missing, or its value is not of its type or range.
    """
    task = type(env).__name__
    init_fields = {field.name: field for field in dataclasses.fields(env.Settings) if field.init}
    for name in arguments:
        checks.check_name(f"argument of {task}", name, init_fields)
    no_default = dataclasses.MISSING
    # Before the dataclass complains, which would name its constructor and not the task.
    required = [
        x.name for x in init_fields.values() if x.default is x.default_factory is no_default
    ]
    missing = [name for name in required if name not in arguments]
    if missing:
        raise ValueError(
            f"{task} needs {', '.join(missing)}: pass them, or give them defaults in its Settings"
        )
    for name, field in init_fields.items():
        value = arguments.get(name, field.default)
        # Defaults are checked as well: a task of the user's own may have one of another type.
        if value is not no_default:
            checks.check_type(f"{name} of {task}", value, field.type)
        if checks.is_nan(value):
            raise ValueError(f"{name} of {task} must be a number, got nan")
    return env.Settings(**arguments)


def split_words(words: Sequence[str]) -> dict[str, str]:
    """Returns the texts of settings by their names, from words NAME=VALUE.

    Raises:
      ValueError: a word is of another form, or a name stands twice.
    """
    value_texts: dict[str, str] = {}
    for word in words:
        # Names as flags have them, too: --env-set frame-skip=2.
        name, equals, text = word.partition("=")
        name = name.replace("-", "_")
        if not (equals and name.isidentifier() and text):
            raise ValueError(
                f"--env-set takes NAME=VALUE, such as ctrl_cost_weight=0.1, got {word!r}"
            )
        if name in value_texts:
            raise ValueError(f"--env-set has {name} twice: {value_texts[name]} and {text}")
        value_texts[name] = text
    return value_texts


def read_settings(task: object, words: Sequence[str]) -> dict[str, Any]:
    """Returns arguments of a task's constructor, from words NAME=VALUE.

    Args:
      task: the class, with the dataclass ``Settings`` whose annotations say how texts are read:
        numbers, text, None, True or False, and tuples as 0.2,1.
      words: as ``--env-set`` has them.

    Raises:
      ValueError: a name is unknown, or a text is not of its type.
    """
    value_texts = split_words(words)
    task_name = getattr(task, "__name__", str(task))
    schema = getattr(task, "Settings", None)
    if not dataclasses.is_dataclass(schema):
        raise ValueError(
            f"--env-set {' '.join(words)} has no effect on {task_name}: it is not a class with a "
            "dataclass Settings, as MujocoEnv has"
        )
    # Resolved: under ``from __future__ import annotations`` a field's type is text.
    kinds = typing.get_type_hints(schema)
    types = {field.name: kinds[field.name] for field in dataclasses.fields(schema) if field.init}
    for name in value_texts:
        checks.check_name(f"setting of {task_name}", name, types)
    arguments = {}
    for name, text in value_texts.items():
        try:
            arguments[name] = checks.read_as(types[name], text)
        except (ValueError, TypeError):
            kind = checks.spoken_kind(types[name])
            raise ValueError(
                f"--env-set {name} of {task_name} must be {kind}, got {text!r}"
            ) from None
    return arguments
