"""Observations scaled by the mean and standard deviation of the first ones."""

import jax
import jax.numpy as jnp
from flax import struct

from mjx_reinforce.engine.base import Trajectory

#: Scaled observations are clipped to plus or minus this many standard deviations.
CLIP = 10.0
_MIN_STD = 1e-4
#: Whole numbers are exact in float32 up to this.
_MAX_EXACT = 2**24
# A larger observation counts as this: float32 holds the sum of the squares of 1e8 of them.
_MAX_OBSERVATION = 1e15


class Normalizer(struct.PyTreeNode, kw_only=True):
    """The mean and variance of the observations counted so far, in a form that can be merged.

    count: [] number of observations
    mean: [O] their mean
    m2: [O] the sum of their squared deviations from the mean
    """

    count: jax.Array
    mean: jax.Array
    m2: jax.Array

    def __repr__(self) -> str:
        return f"Normalizer(observation {list(self.mean.shape)})"


def init(observation_size: int) -> Normalizer:
    """Returns the statistics before any observation; with them ``apply`` changes nothing."""
    zeros = jnp.zeros(observation_size)
    return Normalizer(count=jnp.zeros(()), mean=zeros, m2=zeros)


def update(
    normalizer: Normalizer,
    observation: jax.Array,
    mask: jax.Array,
    max_count: float,
    min_std: float | jax.Array = 0.0,
) -> Normalizer:
    """Merges a batch into the statistics, unless enough observations are counted already.

    By the parallel rule of Chan, Golub and LeVeque (1979). It stays accurate in float32;
    the difference of the mean square and the squared mean would not.

    Args:
      normalizer: the statistics so far.
      observation: [T, N, O]; entries outside the mask have no effect, and one beyond 1e15 counts
        as 1e15.
      mask: [T, N] True where the observation counts.
      max_count: a batch is merged only if fewer observations than this are counted so far.
      min_std: a smaller standard deviation of the two together is raised to this, in the
        observation's unit, and has that size when the next batch is merged.

    Returns:
      The statistics of both together, or those so far.
    """
    # With an empty mask the batch has no weight, and everything below leaves the statistics alone:
    # there is no branch, which would be run both ways under ``vmap`` anyway.
    mask = mask & (normalizer.count < jnp.asarray(max_count, normalizer.count.dtype))
    is_played = mask[..., None]
    observation = jnp.clip(observation, -_MAX_OBSERVATION, _MAX_OBSERVATION)
    count = jnp.sum(mask, dtype=normalizer.count.dtype)
    divisor = jnp.maximum(count, 1.0)
    mean = jnp.sum(jnp.where(is_played, observation, 0.0), axis=(0, 1)) / divisor
    m2 = jnp.sum(jnp.where(is_played, (observation - mean) ** 2, 0.0), axis=(0, 1))
    total_count = jnp.maximum(normalizer.count + count, 1.0)
    delta = mean - normalizer.mean
    # XLA would compile the sums below otherwise beside ``_m2_of_long_count``, and round them
    # otherwise.
    operands = jax.lax.optimization_barrier((normalizer, count, delta, m2))
    # Chan et al.: the squares within each part, and those between the parts' means.
    m2 = normalizer.m2 + m2 + delta**2 * normalizer.count * count / total_count
    m2 = jnp.where(total_count > _MAX_EXACT, _m2_of_long_count(*operands), m2)
    # The floor goes into m2: ``apply`` has the statistics alone, and knows no floor.
    return Normalizer(
        count=normalizer.count + count,
        mean=normalizer.mean + delta * count / total_count,
        m2=jnp.maximum(m2, min_std**2 * (normalizer.count + count)),
    )


def _m2_of_long_count(
    normalizer: Normalizer, count: jax.Array, delta: jax.Array, m2: jax.Array
) -> jax.Array:
    """Returns the sum of squares [O] of a long count and a batch, whose count is rounded.

    That rounding would tell in the ratio of two long sums: a batch moves the variance by the share
    that it has in the count as it is kept.

    Args:
      normalizer: the statistics so far.
      count: [] of the batch.
      delta: [O] its mean minus theirs.
      m2: [O] its sum of squares.
    """
    total_count = jnp.maximum(normalizer.count + count, 1.0)
    variance = normalizer.m2 / jnp.maximum(normalizer.count, 1.0)
    # Not ``count``: what of it is left where float32 rounds the long count.
    new_share = (normalizer.count + count - normalizer.count) / total_count
    variance_change = (
        m2 / jnp.maximum(count, 1.0) + delta**2 * normalizer.count / total_count - variance
    )
    return (variance + new_share * variance_change) * total_count


def between(old_normalizer: Normalizer, new_normalizer: Normalizer, share: jax.Array) -> Normalizer:
    """Returns the statistics a share [] of the way; 1 leads to ``new_normalizer``."""
    blend = jax.tree.map(lambda old, new: old + share * (new - old), old_normalizer, new_normalizer)
    # old + 1 * (new - old) is not new in floating point.
    return jax.tree.map(lambda old, new: jnp.where(share < 1.0, old, new), blend, new_normalizer)


def apply(normalizer: Normalizer, observation: jax.Array) -> jax.Array:
    """Returns ``observation`` [..., O] in standard deviations from the mean, clipped to +-10.

    While no observation is counted, it is returned unchanged.
    """
    std = standard_deviation(normalizer)
    scaled_observation = jnp.clip((observation - normalizer.mean) / std, -CLIP, CLIP)
    return jnp.where(normalizer.count > 0, scaled_observation, observation)


def scale_observations(normalizer: Normalizer, trajectory: Trajectory) -> Trajectory:
    """Returns a trajectory with scaled observations [T, N, O]."""
    return trajectory.replace(observation=apply(normalizer, trajectory.observation))


def standard_deviation(normalizer: Normalizer) -> jax.Array:
    """Returns what ``apply`` divides by, [O]: the standard deviation, and 1e-4 at least."""
    variance = normalizer.m2 / jnp.maximum(normalizer.count, 1.0)
    return jnp.maximum(jnp.sqrt(variance), _MIN_STD)
