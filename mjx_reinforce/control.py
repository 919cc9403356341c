"""Loops that stay loops when they are vmapped over seeds."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

Carry = TypeVar("Carry")


@jax.custom_batching.custom_vmap
def any_lane(x: jax.Array) -> jax.Array:
    """Returns whether any entry of ``x`` is True, over the axes of outer vmaps too.

    ``jnp.any`` under ``vmap`` gives one answer a seed, and a ``while_loop`` on it
    then selects between the old and the new value of its whole carry. This gives
    one answer for all seeds.
    """
    return jnp.any(x)


@any_lane.def_vmap
def _any_lane_batched(axis_size, in_batched, x):
    del axis_size, in_batched
    return any_lane(x), False


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
