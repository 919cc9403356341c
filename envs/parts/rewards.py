"""Terms of a reward, and their weighted sum.

Means, not sums, of squares: a weight says the same of a robot with any number of actuators.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from mjx_reinforce.engine.checks import require


def tracking(error: ArrayLike, width: float) -> jax.Array:
    """Returns exp(-|error|^2 / width^2) []: 1 without an error, 0.37 where it is the width.

    This is the term of Rudin et al., Learning to Walk in Minutes Using Massively Parallel Deep
    Reinforcement Learning, 2022; legged_gym calls width^2 tracking_sigma, which is 0.25.

    Args:
      error: [] or [n] the distance from a command (m/s, rad/s).
      width: in the error's unit.
    """
    return jnp.exp(-jnp.sum(jnp.square(error)) / width**2)


def upright(gravity: jax.Array) -> jax.Array:
    """Returns 1 where a body is upright, 0.5 where it lies on a side, and 0 upside down [].

    This is the term of dm_control's walker (Tassa et al., DeepMind Control Suite, 2018).

    Args:
      gravity: [3] its direction in the body's frame, of which z is up.
    """
    return (1 - gravity[2]) / 2


def action_rate(action: jax.Array, last_action: jax.Array) -> jax.Array:
    """Returns the mean square [] of the change of an action [A]; its weight is negative."""
    return jnp.mean(jnp.square(action - last_action))


def effort(force: jax.Array, limit: ArrayLike) -> jax.Array:
    """Returns the mean square [] of forces relative to their limits; its weight is negative.

    Args:
      force: [nu] of the actuators, as ``data.actuator_force`` (N, N m).
      limit: [nu] the most that each can do, such as ``mj_model.actuator_forcerange[:, 1]``.
    """
    return jnp.mean(jnp.square(force / jnp.asarray(limit)))


def weighted(
    weights: Mapping[str, float], terms: Mapping[str, ArrayLike]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the sum of weighted terms [], and each as "reward_NAME", as reports show them.

    Args:
      weights: of the terms by their names; those of costs are negative.
      terms: [] each.

    Raises:
      ValueError: the names differ.
    """
    missing = [f"no weight for the term {name!r}" for name in terms if name not in weights]
    missing += [f"no term for the weight {name!r}" for name in weights if name not in terms]
    require(not missing, f"weights and terms need the same names: {', '.join(missing)}")
    products = {f"reward_{name}": weights[name] * jnp.asarray(term) for name, term in terms.items()}
    return jnp.sum(jnp.stack([*products.values()])), products
