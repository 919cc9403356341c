"""Steps drawn from the episodes of a rollout."""

import jax
import jax.numpy as jnp


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
