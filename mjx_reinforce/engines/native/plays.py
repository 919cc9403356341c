"""What machine code is told of each episode: how many steps it has at most, and its actions.

That is one number: n > 0, at most n steps by samples; -n, at most n steps by the distribution's
mode; 0, the episode is not played.
"""

import jax
import jax.numpy as jnp

#: The number of an episode that is not played.
NOT_PLAYED = 0


def plays(
    active: bool | jax.Array, deterministic: bool | jax.Array, limit: int | jax.Array
) -> jax.Array:
    """Returns the numbers, int32, of episodes that are played, take the mode and end by the limit.

    An episode with a limit of 0 is not played.
    """
    steps = jnp.maximum(jnp.asarray(limit, jnp.int32), 0)
    return jnp.where(active, jnp.where(deterministic, -steps, steps), NOT_PLAYED)
