"""Samples of a rollout: summed over in chunks of time and in groups, and drawn.

Arrays are [T, N, ...], of N episodes of T steps, with a mask [T, N] of the steps that were played.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from optax import Params

from mjx_reinforce.engine.episode import largest_divisor, while_any

#: Samples whose activations are held at once; 2**18 of them take 64 MB a 64-unit layer.
MAX_SAMPLES = 2**18
#: A GPU holds so many times as many: it made an H200's gradients 1.2 times as fast.
GPU_FACTOR = 4
#: Steps a chunk covers at most, so that short episodes cost little.
MAX_STEPS = 128
#: On a GPU, a network's gradient is summed over so many groups of samples at most ...
_MAX_GROUPS = 32
#: ... with so many samples each, or more.
_MIN_GROUP = 256


def accumulate_gradient(
    loss: Callable[[Any, Any], tuple[jax.Array, Any]],
    params: Params,
    sample_arrays: tuple[Any, ...],
) -> tuple[jax.Array, Any, Any]:
    """Sums a loss, its gradient and its metrics over chunks of time.

    Args:
      loss: (params, chunk of data) -> (sum over the chunk, sums of metrics).
      params: what is differentiated.
      sample_arrays: arrays [T, N, ...]; the last is the mask [T, N], and time steps after
        the last one with any True are not visited.

    Returns:
      The loss [] (without it XLA rounds the rest otherwise), its gradient, the metrics: all summed.
    """
    # Chunk by chunk, as the activations of all T * N samples need not fit into memory at once.
    differentiate = jax.value_and_grad(loss, has_aux=True)

    def visit(chunk):
        (chunk_loss, metrics), grads = differentiate(params, chunk)
        return chunk_loss, grads, metrics

    return accumulate(visit, sample_arrays)


def accumulate(chunk_function: Callable[[Any], Any], sample_arrays: tuple[Any, ...]) -> Any:
    """Sums a function over chunks of time.

    Args:
      chunk_function: chunk of data -> a pytree of sums over the chunk, of zeros where its mask
        is empty.
      sample_arrays: as for ``accumulate_gradient``.
    """
    chunks, has_steps = in_chunks(sample_arrays)
    shapes = jax.eval_shape(chunk_function, chunk_at(chunks, jnp.zeros((), jnp.int32)))

    def body(carry):
        # A seed that is done adds zeros: its mask is empty in the chunks that others still visit.
        index, sums = carry
        return index + 1, jax.tree.map(jnp.add, sums, chunk_function(chunk_at(chunks, index)))

    zero_sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return while_any(while_needed(has_steps), body, (jnp.zeros((), jnp.int32), zero_sums))[1]


def in_groups(apply: Callable[[Any, jax.Array], jax.Array]) -> Callable[..., jax.Array]:
    """Returns ``apply`` with a gradient that a GPU sums in groups of samples, and then over them.

    The gradient of a layer's weights is a product of matrices with few entries, each of them a sum
    over all samples. cuBLAS gives an entry's sum to one multiprocessor, so that most of them wait.

    Args:
      apply: (params, inputs [B, ..., O]) -> outputs [B, ..., K] or [B, ...], of each sample by
        itself.
    """

    def apply_in_groups(params: Any, inputs: jax.Array) -> jax.Array:
        """Returns the outputs of copies of the parameters, one for each group."""
        num_groups = _num_groups(inputs.shape)
        if num_groups == 1:
            return apply(params, inputs)
        # The gradient in a copy is the group's sum. Behind the barrier, XLA does not know that they
        # are copies, and joins no sums.
        copies = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_groups, *x.shape)), params)
        # Along the first axis alone: the second may be divided among devices.
        groups = inputs.reshape(num_groups, -1, *inputs.shape[1:])
        outputs = jax.vmap(apply)(lax.optimization_barrier(copies), groups)
        return outputs.reshape(-1, *outputs.shape[2:])

    return apply_in_groups


def _num_groups(shape: tuple[int, ...]) -> int:
    """Returns in how many groups of B the gradient of samples [B, ..., O] is summed."""
    if jax.default_backend() == "cpu":
        return 1
    num_samples = math.prod(shape[:-1])
    return largest_divisor(shape[0], max(1, min(_MAX_GROUPS, num_samples // _MIN_GROUP)))


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
    sampled_ranks = jax.random.randint(key, shape, 1, 1 + jnp.maximum(ranks[-1], 1))
    # Where the first, second, ... step inside the mask is; ``sampled_ranks`` count from 1.
    return jnp.searchsorted(ranks, sampled_ranks)


def in_chunks(sample_arrays: tuple[Any, ...]) -> tuple[tuple[Any, ...], jax.Array]:
    """Returns the data [C, length, N, ...], and which of the C chunks have a step to visit."""
    horizon, num_episodes = sample_arrays[-1].shape
    # It divides T, so that all chunks have one shape, as a loop needs it.
    length = chunk_length(horizon, num_episodes)
    chunks = jax.tree.map(
        lambda x: x.reshape(horizon // length, length, *x.shape[1:]), sample_arrays
    )
    return chunks, jnp.any(chunks[-1], axis=(1, 2))


def chunk_length(horizon: int, num_episodes: int) -> int:
    """Returns how many steps of all episodes are visited at once."""
    samples = MAX_SAMPLES * (1 if jax.default_backend() == "cpu" else GPU_FACTOR)
    return largest_divisor(horizon, min(MAX_STEPS, max(1, samples // num_episodes)))


def chunk_at(chunks: tuple[Any, ...], index: jax.Array) -> tuple[Any, ...]:
    """Returns one of these chunks [length, N, ...]."""
    return jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, index, keepdims=False), chunks)


def while_needed(has_steps: jax.Array) -> Callable[[Any], jax.Array]:
    """Returns the condition of a loop over chunks [C]; its carry begins with an index.

    Args:
      has_steps: [C] whether any step of a chunk was played.
    """

    def has_next(carry):
        # Where one chunk is empty, so are all after it: no step follows an episode's end.
        index = carry[0]
        return (index < has_steps.size) & has_steps[jnp.minimum(index, has_steps.size - 1)]

    return has_next
