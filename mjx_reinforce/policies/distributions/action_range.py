"""The range of a continuous action space, as the distributions need it."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.types import Box, Discrete


def continuous_box(name: str, space: Box | Discrete) -> Box:
    """Returns the action space if it is continuous.

    Args:
      name: the family's name, for the message.
      space: the action space.

    Raises:
      ValueError: the space is discrete.
    """
    check_space(name, space)
    if not isinstance(space, Box):
        raise ValueError(
            f"{name} needs a continuous action space, this one is discrete; choose categorical"
        )
    return space


def check_space(name: str, space: Box | Discrete) -> None:
    """Raises ValueError for what is no action space."""
    if not isinstance(space, Box | Discrete):
        raise ValueError(
            f"{name} needs an action space, such as env.action_space, or mjx_reinforce.Box(low, "
            f"high) with arrays [A], got a {type(space).__name__}"
        )


def finite_box(name: str, space: Box | Discrete) -> Box:
    """Returns the action space if it is continuous and all its bounds are finite.

    Args:
      name: the family's name, for the message.
      space: the action space.

    Raises:
      ValueError: the space is discrete, or an entry is unbounded.
    """
    box = continuous_box(name, space)
    if not np.all(np.isfinite(box.low) & np.isfinite(box.high)):
        raise ValueError(
            f"{name} needs finite action bounds, got {box}; "
            "choose normal, or declare bounds in the environment's action_space"
        )
    return box


def bounds(box: Box, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the lower and upper bounds, [A] each, in the dtype of ``like``."""
    return jnp.asarray(box.low, like.dtype), jnp.asarray(box.high, like.dtype)


def middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centre and half the width of each entry's range, [A] each.

    They are 0 and 1 for an entry that is not bounded on both sides.
    """
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2
