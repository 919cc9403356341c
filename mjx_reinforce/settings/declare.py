"""How a setting is declared: marks stand with its type, its default and its help.

They say what must hold of its value, what reads it, and what sweeps and resumed runs may do with
it. Every table of settings is an answer of ``config.marked``.
"""

import dataclasses
import enum
import math
from collections.abc import Callable
from typing import Any, TypeVar

from mjx_reinforce.engine.checks import MAX_OF_UPDATE

Value = TypeVar("Value")

#: What is counted exactly, as a double does; see ``engine.counts``.
MAX_COUNT = 2**53


class Range(enum.Enum):
    """What must hold of a value that is a number or numbers; checked in this order.

    words: the range, for messages
    holds: whether a value is in it
    """

    def __init__(self, words: str, holds: Callable[[Any], bool]):
        self.words = words
        self.holds = holds

    AT_LEAST_1 = "at least 1", lambda x: x >= 1
    AT_LEAST_0 = "at least 0", lambda x: x >= 0
    COUNTED = "at most 2^53, for no more is counted exactly", lambda x: x <= MAX_COUNT
    INT32 = "less than 2^31", lambda x: x <= MAX_OF_UPDATE
    SEED = "in [0, 2^32)", lambda x: 0 <= x < 2**32
    SHARE = "in [0, 1]", lambda x: 0 <= x <= 1
    BELOW_1 = "in [0, 1 - 2^-24], the last float32 below 1", lambda x: 0 <= x <= 1 - 2**-24
    LAYERS = "in [1, 2^31) in every layer", lambda x: all(1 <= n <= MAX_OF_UPDATE for n in x)
    POSITIVE = "positive and finite", lambda x: math.isfinite(x) and x > 0
    NOT_NEGATIVE = "finite and not negative", lambda x: math.isfinite(x) and x >= 0


#: What holds of numbers of a kind.
COUNT = (Range.AT_LEAST_1, Range.INT32)
TOTAL = (Range.AT_LEAST_1, Range.COUNTED)


class Mark(enum.Enum):
    """What else a setting may be."""

    TRACED = "a sweep may hand it to a program as an argument"
    BUDGET = "it may change when a run goes on"
    PLACE = "it says where a run is, not what it does"
    NOT_COMPILED = "no program on disk depends on it: it is an input, or of no concern"


def setting(default: Value, *marks: enum.Enum, once: str | None = None) -> Value:
    """Returns the field of a setting.

    Args:
      default: its value where the user gives none.
      marks: what holds of it: members of ``Range``, ``groups.Reader`` and ``Mark``.
      once: why a sweep cannot go over it; None if it can.
    """
    return dataclasses.field(default=default, metadata={"marks": marks, "once": once})
