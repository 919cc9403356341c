"""Noise of sensors: each is drawn in ``MujocoEnv.remember``, with the key of the env step."""

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike


def uniform_noise(key: jax.Array, half_width: ArrayLike) -> jax.Array:
    """Returns noise [...] that is uniform in ±half_width [...]; consumes the key."""
    half_width = jnp.asarray(half_width, float)
    return half_width * jax.random.uniform(key, half_width.shape, half_width.dtype, -1.0, 1.0)


def normal_noise(key: jax.Array, std: ArrayLike) -> jax.Array:
    """Returns normal noise [...] with the standard deviations std [...]; consumes the key."""
    std = jnp.asarray(std, float)
    return std * jax.random.normal(key, std.shape, std.dtype)
