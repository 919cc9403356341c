"""Sums, maps and draws over the steps of episodes; dead chunks of time are skipped."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from optax import Params

from mjx_reinforce.engine.play.episode import largest_divisor, while_any

#: Samples whose activations are held at once; 2**18 of them take 64 MB a 64-unit layer.
MAX_SAMPLES = 2**18
#: A GPU holds so many times as many: it made an H200's gradients 1.2 times as fast.
GPU_FACTOR = 4
#: Steps a chunk covers at most, so that short episodes cost little.
MAX_STEPS = 128


def accumulate_gradient(
    loss: Callable[[Any, Any], tuple[jax.Array, Any]],
    params: Params,
    data: tuple[Any, ...],
) -> tuple[jax.Array, Any, Any]:
    """Sums a loss, its gradient and its metrics over chunks of time.

    Args:
      loss: (params, chunk of data) -> (sum over the chunk, sums of metrics).
      params: what is differentiated.
      data: arrays [T, N, ...]; the last is the mask [T, N], and time steps after
        the last one with any True are not visited.

    Returns:
      The loss [], its gradient like ``params``, and the metrics, all summed.
    """
    differentiate = jax.value_and_grad(loss, has_aux=True)

    def visit(chunk):
        (value, metrics), grads = differentiate(params, chunk)
        return value, grads, metrics

    return accumulate(visit, data)


def accumulate(function: Callable[[Any], Any], data: tuple[Any, ...]) -> Any:
    """Sums a function over chunks of time.

    Args:
      function: chunk of data -> a pytree of sums over the chunk, of zeros where its mask is empty.
      data: as for ``accumulate_gradient``.
    """
    chunks, needed = _in_chunks(data)
    sums = jax.eval_shape(function, _chunk(chunks, jnp.zeros((), jnp.int32)))

    def body(carry):
        index, sums = carry
        return index + 1, jax.tree.map(jnp.add, sums, function(_chunk(chunks, index)))

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), sums)
    return while_any(while_needed(needed), body, (jnp.zeros((), jnp.int32), zeros))[1]


def map_steps(function: Callable[[Any], jax.Array], data: tuple[Any, ...]) -> jax.Array:
    """Applies a function of single steps to all of them; returns [T, N], 0 outside the mask.

    Args:
      function: data [..., *] of any steps -> a number for each, [...].
      data: as for ``accumulate_gradient``.
    """
    chunks, needed = _in_chunks(data)

    def body(carry):
        index, values = carry
        chunk = _chunk(chunks, index)
        own = jnp.where(chunk[-1], function(chunk), 0.0)
        return index + 1, lax.dynamic_update_index_in_dim(values, own, index, 0)

    one = jax.eval_shape(function, _chunk(chunks, jnp.zeros((), jnp.int32)))
    zeros = jnp.zeros((needed.size, *one.shape), one.dtype)
    values = while_any(while_needed(needed), body, (jnp.zeros((), jnp.int32), zeros))[1]
    return values.reshape(data[-1].shape)


def draw_steps(key: jax.Array, mask: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws steps with replacement, every one inside the mask alike.

    Args:
      key: consumed.
      mask: [T, N] or [T * N] True where there is a step.
      shape: of what is returned.

    Returns:
      Indices int32 [*shape] into arrays [T * N, ...]; where there is no step, that of any.
    """
    ranks = jnp.cumsum(mask.reshape(-1))
    drawn = jax.random.randint(key, shape, 1, 1 + jnp.maximum(ranks[-1], 1))
    # Where the first, second, ... step inside the mask is; ``drawn`` counts from 1.
    return jnp.searchsorted(ranks, drawn)


def _in_chunks(data: tuple[Any, ...]) -> tuple[tuple[Any, ...], jax.Array]:
    """Returns the data [C, length, N, ...], and which of the C chunks have a step to visit."""
    horizon, num_episodes = data[-1].shape
    samples = MAX_SAMPLES * (1 if jax.default_backend() == "cpu" else GPU_FACTOR)
    length = largest_divisor(horizon, min(MAX_STEPS, max(1, samples // num_episodes)))
    chunks = jax.tree.map(lambda x: x.reshape(horizon // length, length, *x.shape[1:]), data)
    return chunks, jnp.any(chunks[-1], axis=(1, 2))


def _chunk(chunks: tuple[Any, ...], index: jax.Array) -> tuple[Any, ...]:
    return jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, index, keepdims=False), chunks)


def while_needed(needed: jax.Array) -> Callable[[Any], jax.Array]:
    """Returns the condition of a loop over what is needed [C]; its carry begins with an index."""

    def more(carry):
        index = carry[0]
        return (index < needed.size) & needed[jnp.minimum(index, needed.size - 1)]

    return more
