"""The arguments of an environment: a frozen dataclass, nested in the class as ``Settings``.

Each argument stands once, with its default, unit and check, in the class that reads it; a task's
``Settings`` inherits from that of the task's base and changes defaults or adds fields.
"""

import dataclasses
from typing import Any

from mjx_reinforce.checks import check_type, is_nan
from mjx_reinforce.registry import check_name

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
        check_positive("max_episode_steps", self.max_episode_steps)


def build_settings(env: Any, arguments: dict[str, Any]) -> Any:
    """Returns the settings of an environment's class.

    Args:
      env: the environment; its class has the dataclass ``Settings``.
      arguments: the keyword arguments of its constructor.

    Raises:
      ValueError: an argument is unknown or missing, or its value is not of its type or range.
    """
    task = type(env).__name__
    known = {field.name: field for field in dataclasses.fields(env.Settings) if field.init}
    for name in arguments:
        check_name(f"argument of {task}", name, known)
    missing = [name for name, field in known.items() if _needed(field) and name not in arguments]
    if missing:
        raise ValueError(
            f"{task} needs {', '.join(missing)}: pass them, or give them defaults in its Settings"
        )
    for name, field in known.items():
        value = arguments.get(name, field.default)
        if value is not dataclasses.MISSING:
            check_type(f"{name} of {task}", value, field.type)
        if is_nan(value):
            raise ValueError(f"{name} of {task} must be a number, got nan")
    return env.Settings(**arguments)


def _needed(field: dataclasses.Field[Any]) -> bool:
    """Returns whether an argument has no default."""
    return field.default is field.default_factory is dataclasses.MISSING


def check_positive(name: str, value: int) -> None:
    """Raises ValueError for a number below 1."""
    if value < 1:
        raise ValueError(f"{name} must be 1 or more, got {value}")


def check_range(name: str, bounds: Interval) -> None:
    """Raises ValueError for a range that contains nothing."""
    low, high = bounds
    if not low < high:
        raise ValueError(f"{name} must be (low, high) with low < high, got {bounds}")
