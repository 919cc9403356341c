"""What was, a number of env steps ago: late actions, late observations."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike


def history(entry: ArrayLike, length: int) -> jax.Array:
    """Returns a history [length, ...] of the same entry [...], as an episode begins with.

    Raises:
      ValueError: the length is less than 1.
    """
    if length < 1:
        raise ValueError(f"a history has a length of at least 1, got {length}")
    entry = jnp.asarray(entry)
    return jnp.broadcast_to(entry, (length, *entry.shape))


def append(history: jax.Array, entry: ArrayLike) -> jax.Array:
    """Returns a history [length, ...] with a new last entry [...], without its oldest."""
    return jnp.concatenate([history[1:], jnp.asarray(entry)[None]])


def delayed(history: jax.Array, num_steps: int | jax.Array) -> jax.Array:
    """Returns the entry [...] that was the newest one a number of env steps ago.

    Args:
      history: [length, ...], the newest entry last.
      num_steps: of the delay, from 0 to length - 1; an int, or integers that an episode has drawn,
        [] or one for each number of an entry. Of what is drawn, more means the oldest entry.

    Raises:
      ValueError: the history is too short.
    """
    length = len(history)
    if isinstance(num_steps, int | np.integer) and not 0 <= num_steps < length:
        raise ValueError(
            f"a history of length {length} has no entry {num_steps} env steps before the newest; "
            f"give it the length {num_steps + 1}, and a delay of 0 or more"
        )
    # No index that is drawn: a choice between all entries is as fast in machine code, and keeps a
    # NaN in one entry out of the others.
    entry = history[-1]
    for age in range(1, length):
        entry = jnp.where(num_steps >= age, history[-1 - age], entry)
    return entry
