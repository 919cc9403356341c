"""The arguments of an environment: a frozen dataclass, nested in the class as ``Settings``.

Each argument stands once, with its default, unit and check, in the class that reads it; a task's
``Settings`` inherits from that of the task's base and changes defaults or adds fields.
"""

import dataclasses
from typing import Any

from mjx_reinforce.registry import check_name

Range = tuple[float, float]


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
      ValueError: an argument is unknown, or its value is out of its range.
    """
    known = {field.name: field for field in dataclasses.fields(env.Settings)}
    for name in arguments:
        check_name(f"argument of {type(env).__name__}", name, known)
    return env.Settings(**arguments)


def check_positive(name: str, value: int) -> None:
    """Raises ValueError for a number below 1."""
    if value < 1:
        raise ValueError(f"{name} must be 1 or more, got {value}")


def check_range(name: str, bounds: Range) -> None:
    """Raises ValueError for a range that contains nothing."""
    low, high = bounds
    if not low < high:
        raise ValueError(f"{name} must be (low, high) with low < high, got {bounds}")
