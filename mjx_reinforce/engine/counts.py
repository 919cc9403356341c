"""Counts up to 2^53 that are exact on every device, also where JAX has no 64-bit numbers.

A count is two words, uint32 [..., 2]: the number of 2^32, and the rest.
"""

import jax
import jax.numpy as jnp
import numpy as np

Count = jax.Array | np.ndarray


def from_int(number: int) -> np.ndarray:
    """Returns a whole number from 0 to 2^53 as a count [2]."""
    return np.array(divmod(number, 2**32), np.uint32)


def to_int(count: Count) -> np.ndarray:
    """Returns counts [..., 2] as int64 [...] on the host."""
    words = np.asarray(count).astype(np.int64)
    return words[..., 0] * 2**32 + words[..., 1]


def zero() -> jax.Array:
    """Returns the count [2] of nothing."""
    return jnp.zeros(2, jnp.uint32)


def plus(count: Count, increment: int | jax.Array) -> jax.Array:
    """Returns a count [2], a whole number [] from 0 to 2^32 - 1 later."""
    # Sums of uint32 wrap around at 2^32: one that is below what was added to has carried.
    low_word = count[1] + jnp.asarray(increment).astype(jnp.uint32)
    return jnp.stack([count[0] + (low_word < count[1]), low_word])


def reached(count: Count, limit: Count) -> jax.Array:
    """Returns whether [...] counts [..., 2] are at a limit [2] or beyond."""
    high_word = jnp.asarray(count[..., 0])
    low_word = jnp.asarray(count[..., 1])
    return (high_word > limit[0]) | ((high_word == limit[0]) & (low_word >= limit[1]))


def as_float(count: Count) -> jax.Array:
    """Returns counts [..., 2] as floats [...], to their precision."""
    words = jnp.asarray(count).astype(float)
    return words[..., 0] * 2.0**32 + words[..., 1]
