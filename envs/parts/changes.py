"""What changes in an episode: commands, and pushes."""

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import check_count, require
from mjx_reinforce.engine.team.supported import FREE


def is_due(step: ArrayLike, period: int) -> jax.Array:
    """Returns whether a count of env steps is a multiple of a period (env steps, at least 1)."""
    check_count("period", period)
    return jnp.asarray(step) % period == 0


def command(key: jax.Array, low: ArrayLike, high: ArrayLike, rest_share: float = 0.0) -> jax.Array:
    """Draws a command [n], such as a velocity that the robot is to have; consumes the key.

    Args:
      key: of an env step or an episode.
      low: [n] the least of each number (m/s, rad/s).
      high: [n] the most.
      rest_share: the probability that all are 0, so that the robot learns to stand.
    """
    low = jnp.asarray(low, float)
    rest_key, key = jax.random.split(key)
    shares = jax.random.uniform(key, low.shape, low.dtype)
    speeds = low + (jnp.asarray(high, float) - low) * shares
    return jnp.where(jax.random.uniform(rest_key) < rest_share, 0.0, speeds)


def push(key: jax.Array, speed: ArrayLike, is_due: ArrayLike) -> jax.Array:
    """Draws a change of the horizontal velocity [2] (m/s) where a push is due; consumes the key.

    It is uniform in ±speed in x and in y, as in legged_gym (Rudin et al. 2022).

    Args:
      key: of an env step.
      speed: [] the most in each direction (m/s).
      is_due: [] whether there is a push; else the change is 0.
    """

    def change(key: jax.Array) -> jax.Array:
        shares = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return jnp.asarray(speed, float) * shares

    def no_change(key: jax.Array) -> jax.Array:
        return jnp.zeros(2)

    # A branch, as numbers are drawn in few steps.
    return jax.lax.cond(jnp.asarray(is_due), change, no_change, key)


def push_velocity(model: MjModel, push: jax.Array) -> jax.Array:
    """Returns what ``MujocoEnv.push`` does: a change [nv] of the velocities by a push [2] (m/s).

    Raises:
      ValueError: the model's first joint is not free.
    """
    require(
        model.njnt > 0 and model.jnt_type[0] == FREE,
        "push_velocity pushes the body of a free joint, and the model's first joint is none; "
        "return a change of each velocity [nv] from push itself, or begin with a <freejoint/>",
    )
    return jnp.zeros(model.nv, push.dtype).at[:2].set(push)
