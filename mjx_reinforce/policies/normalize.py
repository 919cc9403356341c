"""Mean and standard deviation of the first observations, exact over any batch order."""

import jax
import jax.numpy as jnp
from flax import struct

_CLIP = 10.0
_MIN_STD = 1e-4


@struct.dataclass(kw_only=True)
class Normalizer:
    """Sufficient statistics of the observations counted so far.

    count: [] how many observations
    mean: [O] their mean
    m2: [O] the sum of their squared deviations from the mean
    """

    count: jax.Array
    mean: jax.Array
    m2: jax.Array


def init(observation_size: int) -> Normalizer:
    """Returns the statistics of no observation; ``apply`` is then the identity."""
    zeros = jnp.zeros(observation_size)
    return Normalizer(count=jnp.zeros(()), mean=zeros, m2=zeros)


def update(
    normalizer: Normalizer, observation: jax.Array, mask: jax.Array, at_most: float
) -> Normalizer:
    """Merges a batch into the statistics, unless enough is counted already.

    The parallel rule of Chan, Golub and LeVeque (1979), which stays accurate in
    float32 where sums of squares cancel.

    Args:
      normalizer: the statistics so far.
      observation: [T, N, O]; entries outside the mask have no effect.
      mask: [T, N] True where the observation counts.
      at_most: a batch is merged while fewer observations than this are counted.

    Returns:
      The statistics of both together, or those so far.
    """
    mask = mask & (normalizer.count < at_most)
    kept = mask[..., None]
    count = jnp.sum(mask, dtype=normalizer.count.dtype)
    divisor = jnp.maximum(count, 1.0)
    mean = jnp.sum(jnp.where(kept, observation, 0.0), axis=(0, 1)) / divisor
    m2 = jnp.sum(jnp.where(kept, (observation - mean) ** 2, 0.0), axis=(0, 1))
    total = jnp.maximum(normalizer.count + count, 1.0)
    delta = mean - normalizer.mean
    return Normalizer(
        count=normalizer.count + count,
        mean=normalizer.mean + delta * count / total,
        m2=normalizer.m2 + m2 + delta**2 * normalizer.count * count / total,
    )


def apply(normalizer: Normalizer, observation: jax.Array) -> jax.Array:
    """Returns ``observation`` [..., O] in standard deviations from the mean, clipped at 10.

    With no observation counted yet it comes back unchanged.
    """
    variance = normalizer.m2 / jnp.maximum(normalizer.count, 1.0)
    std = jnp.maximum(jnp.sqrt(variance), _MIN_STD)
    scaled = jnp.clip((observation - normalizer.mean) / std, -_CLIP, _CLIP)
    return jnp.where(normalizer.count > 0, scaled, observation)
