"""Loops over time in chunks, which stay loops when they are vmapped over seeds."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engines.episode import draw_noise
from mjx_reinforce.fused import any_lane
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.types import PyTree

LoopState = TypeVar("LoopState")

#: Noise is drawn for so many steps at once, and only then is it seen whether all episodes are over.
CHUNK_STEPS = 50


def while_any(
    cond: Callable[[LoopState], jax.Array], body: Callable[[LoopState], LoopState], init: LoopState
) -> LoopState:
    """``lax.while_loop`` that, vmapped, runs as long as any seed needs it.

    The body also runs for a seed that is done: it must leave the result of a
    finished seed as it is.
    """
    return lax.while_loop(lambda carry: any_lane(cond(carry)), body, init)


def largest_divisor(number: int, at_most: int) -> int:
    """Returns the largest divisor of ``number`` that is no greater than ``at_most``."""
    return max(d for d in range(1, min(number, at_most) + 1) if number % d == 0)


def chunk_length(horizon: int) -> int:
    """Returns how many steps a chunk of an episode of at most ``horizon`` steps has."""
    return largest_divisor(horizon, CHUNK_STEPS)


def play_chunks(
    play: Callable[[jax.Array, Any], tuple[Any, Any]],
    distribution: Distribution,
    keys: jax.Array,
    progress: PyTree,
    records: PyTree,
) -> tuple[Any, Any, jax.Array]:
    """Plays chunk after chunk until every episode is over or the time is up.

    Args:
      play: (noise, progress) -> (progress, records of one chunk); the noise is [length, N, E].
      distribution: whose noise is drawn.
      keys: [N] of every episode's noise; consumed.
      progress: where the episodes are; ``progress.alive`` [N] is 0 or False where one is over.
      records: arrays [horizon, ...] of zeros, which the chunks fill.

    Returns:
      The progress at the end, the records, and how many env steps [] were simulated. That counts
      all lanes until the last episode is over, of all seeds that are vmapped together.
    """
    horizon = jax.tree.leaves(records)[0].shape[0]
    length = chunk_length(horizon)
    draw = jax.vmap(functools.partial(draw_noise, distribution, length), out_axes=(0, 1))

    def advance(carry):
        chunk, keys, progress, records = carry
        keys, noise = draw(keys)
        progress, new = play(noise, progress)
        records = jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, chunk * length, 0), records, new
        )
        return chunk + 1, keys, progress, records

    def unfinished(carry):
        chunk, _, progress, _ = carry
        return (chunk < horizon // length) & jnp.any(progress.alive != 0)

    init = (jnp.zeros((), jnp.int32), keys, progress, records)
    chunks, _, progress, records = while_any(unfinished, advance, init)
    return progress, records, chunks * length * progress.alive.size
