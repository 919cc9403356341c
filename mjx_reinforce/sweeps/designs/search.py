"""Configurations drawn at random from ranges and choices."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.settings.config import marked, spoken
from mjx_reinforce.settings.declare import Mark

#: Digits that are kept of what is drawn.
_DIGITS = 4
#: So many times as many draws as configurations are made to find different ones.
_DRAWS_EACH = 100


def draw_configurations(
    over: Mapping[str, Sequence[Any]], count: int, seed: int
) -> list[dict[str, Any]]:
    """Returns different configurations, drawn at random.

    Two numbers are the ends of a range: of rates, standard deviations, floors and norms evenly in
    the logarithm, of the discount evenly in that of 1 - x, of others evenly. Other values, and
    three or more, are choices.

    Args:
      over: the values of each setting.
      count: how many configurations.
      seed: of the draws.

    Raises:
      ValueError: a range has no logarithm, or there are too few configurations.
    """
    generator = np.random.default_rng(seed)
    for name, values in over.items():
        _check_range(name, values)
    drawn: dict[tuple[Any, ...], None] = {}
    for _ in range(_DRAWS_EACH * count):
        values = [_draw(name, values, generator) for name, values in over.items()]
        drawn.setdefault(tuple(values))
        if len(drawn) == count:
            return [dict(zip(over, values, strict=True)) for values in drawn]
    raise ValueError(
        f"only {len(drawn)} different configurations were found for --budget {count}: lower it, "
        "or use --search grid"
    )


def is_range(values: Sequence[Any]) -> bool:
    """Returns whether values are the ends of a range."""
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in values)
    return len(values) == 2 and numbers


def _check_range(name: str, values: Sequence[Any]) -> None:
    if not is_range(values):
        return
    if values[0] > values[1]:
        raise ValueError(f"--over {spoken(name)} {values[0]} {values[1]}: give the lower end first")
    if name in marked(Mark.LOG_OF_REST) and values[1] >= 1:
        raise ValueError(
            f"--over {spoken(name)}: a range ends below 1, got {values[1]}; try 0.9999"
        )
    if name in marked(Mark.LOG) and values[0] <= 0:
        raise ValueError(f"--over {spoken(name)}: a range begins above 0, got {values[0]}")


def _draw(name: str, values: Sequence[Any], generator: np.random.Generator) -> Any:
    """Returns one value."""
    if not is_range(values):
        return values[int(generator.integers(len(values)))]
    low, high = values
    if isinstance(low, int) and isinstance(high, int):
        return int(generator.integers(low, high + 1))
    if name in marked(Mark.LOG_OF_REST):
        rest = math.exp(generator.uniform(math.log(1 - high), math.log(1 - low)))
        return round(1 - _round_digits(rest), 12)
    if name in marked(Mark.LOG):
        return _round_digits(math.exp(generator.uniform(math.log(low), math.log(high))))
    return _round_digits(generator.uniform(low, high))


def _round_digits(x: float) -> float:
    return float(f"{x:.{_DIGITS}g}")
