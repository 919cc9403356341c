"""Reductions over lanes that stay reductions under an outer ``jax.vmap``."""

from typing import Any

import jax
import jax.numpy as jnp


@jax.custom_batching.custom_vmap
def any_lane(predicate: jax.Array) -> jax.Array:
    """Returns whether a predicate holds in any lane, of this batch or of one mapped over it.

    A loop's or a branch's predicate that ``jax.vmap`` batches turns the loop into one that computes
    every lane, and the branch into a selection. This one is never batched: under an outer
    ``jax.vmap`` (say over seeds) it reduces over that axis too, so loops stay loops.

    Args:
      predicate: bools of any shape.

    Returns:
      One bool, the same for every lane of every mapped axis.
    """
    return jnp.any(predicate)


@any_lane.def_vmap
def _reduce_outer_axis(axis_size: int, in_batched: list[bool], predicate: jax.Array) -> Any:
    del axis_size, in_batched
    return any_lane(predicate), False
