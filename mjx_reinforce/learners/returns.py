"""Returns to go of complete episodes, all steps at once, and what stands for a broken one's."""

import math

import jax
import jax.numpy as jnp


def discounted_returns(reward: jax.Array, discount: float | jax.Array) -> jax.Array:
    """Returns G [T, N] with ``G[t] = reward[t] + discount * G[t + 1]`` and ``G[T] = 0``.

    Args:
      reward: [T, N], zero where the episode is over.
      discount: in [0, 1].
    """
    # Products of matrices, in blocks of about sqrt(T) steps: within each block, then over the
    # blocks. A scan takes T steps one after the other, and an associative scan compiles for long.
    discount = jnp.asarray(discount, reward.dtype)
    horizon, num_episodes = reward.shape
    length = math.isqrt(horizon - 1) + 1
    count = -(-horizon // length)
    blocks = jnp.pad(reward, ((0, count * length - horizon), (0, 0)))
    blocks = blocks.reshape(count, length, num_episodes)
    own = _discounted_sums(blocks, discount)
    total = _discounted_sums(own[:, 0], jnp.power(discount, length))
    later = jnp.pad(total[1:], ((0, 1), (0, 0)))
    steps_left = jnp.arange(length, 0, -1, dtype=reward.dtype)
    returns = own + jnp.power(discount, steps_left)[:, None] * later[:, None]
    return returns.reshape(-1, num_episodes)[:horizon]


def replace_broken(
    returns: jax.Array, broken: jax.Array, played: jax.Array | None = None
) -> jax.Array:
    """Returns the returns, of an episode that broke the least of the others'.

    What it earned until the simulation left the finite numbers is no return: where rewards are
    negative, it would speak for breaking early. So would leaving it out: the gradient of what
    remains is that of an episode which earned 0.

    Args:
      returns: [..., N] such as G [T, N]; the others are those of the same step.
      broken: [N] ``Trajectory.nonfinite``; where all are, all returns are infinite.
      played: [N] ``Trajectory.played``.
    """
    without = broken if played is None else broken | ~played
    least = jnp.min(jnp.where(without, jnp.inf, returns), axis=-1, keepdims=True)
    return jnp.where(broken, least, returns)


def _discounted_sums(x: jax.Array, discount: jax.Array) -> jax.Array:
    """Returns y [..., T, N] with ``y[t] = x[t] + discount * y[t + 1]`` and ``y[T] = 0``."""
    time = jnp.arange(x.shape[-2], dtype=x.dtype)
    ahead = time - time[:, None]
    factors = jnp.where(ahead < 0, 0, jnp.power(discount, jnp.maximum(ahead, 0)))
    return jnp.matmul(factors, x, precision="highest")
