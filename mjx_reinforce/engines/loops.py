"""Loops that stay loops when they are vmapped over seeds."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax import lax

from mjx_reinforce.fused import any_lane

Carry = TypeVar("Carry")


def while_any(
    cond: Callable[[Carry], jax.Array], body: Callable[[Carry], Carry], init: Carry
) -> Carry:
    """``lax.while_loop`` that, vmapped, runs as long as any seed needs it.

    A seed that is done goes through the body all the same: a body must leave the
    result of a finished seed as it is.
    """
    return lax.while_loop(lambda carry: any_lane(cond(carry)), body, init)


def largest_divisor(number: int, at_most: int) -> int:
    """Returns the largest divisor of ``number`` that is no greater than ``at_most``."""
    return max(d for d in range(1, min(number, at_most) + 1) if number % d == 0)
