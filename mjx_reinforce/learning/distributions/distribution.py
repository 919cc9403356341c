"""The interface of an action distribution whose parameters a policy network computes.

A distribution is a tuple of pure functions. ``outputs`` [..., K] holds its
parameters: first ``num_outputs`` entries that the network computes from the
observation, then one entry for each of ``constants``, which are trained but do not
depend on the observation. Sampling has two steps, ``noise`` and ``sample``: the noise
depends on the key alone, so an engine can draw it in advance, and every engine gets
the same actions from the same key.

Every family is one function. It takes the action space, ``initial_std`` (the standard
deviation before training, in the action's unit) and ``rescale`` (whether the network's
output is scaled to the action's range). It raises ValueError for a space that it does
not support; the checks are here.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from mjx_reinforce.engine.base import Box, Discrete


class Distribution(NamedTuple):
    """A family of distributions over actions.

    Attributes:
      num_outputs: entries of ``outputs`` that the network computes
      constants: [K - num_outputs] initial values of the entries that are the same in every state
      noise: (key, shape) -> [*shape, E] the noise that ``sample`` transforms; consumes the key
      sample: (outputs [..., K], noise [..., E]) -> action [..., A]; discrete: int32 [...]
      mode: (outputs [..., K]) -> action like ``sample``, the deterministic policy
      log_prob: (outputs [..., K], action [..., A]) -> [...], summed over entries
      entropy: (outputs [..., K]) -> [...], in nats
      num_scales: how many of ``num_outputs``, counted from the last, determine the width
        of the distribution; a second network may compute them
      std: (outputs [..., K]) -> [..., A] the standard deviation in the action's unit, before what
        the family does to keep actions in their range; None where there is none
      kl: (outputs, other outputs) -> [...] the divergence KL(first || second) in nats, if known
      fisher: (constants [K - num_outputs]) -> [K] the diagonal of the Fisher matrix in ``outputs``,
        of a family in which it is diagonal and depends on these alone; else None

    Examples:
      >>> import jax, jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> family = mr.categorical(mr.Discrete(3))
      >>> noise = family.noise(jax.random.key(0), (5,))
      >>> family.sample(jnp.zeros((5, 3)), noise).shape
      (5,)
      >>> round(family.entropy(jnp.zeros(3)).item(), 3)  # log 3
      1.099
    """

    num_outputs: int
    constants: tuple[float, ...]
    noise: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    sample: Callable[[jax.Array, jax.Array], jax.Array]
    mode: Callable[[jax.Array], jax.Array]
    log_prob: Callable[[jax.Array, jax.Array], jax.Array]
    entropy: Callable[[jax.Array], jax.Array]
    num_scales: int = 0
    std: Callable[[jax.Array], jax.Array] | None = None
    kl: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    fisher: Callable[[jax.Array], jax.Array] | None = None

    def __repr__(self) -> str:
        return f"Distribution({self.num_outputs} outputs, {len(self.constants)} constants)"


def check_space(name: str, space: Box | Discrete) -> None:
    """Raises ValueError for what is no action space."""
    if not isinstance(space, Box | Discrete):
        raise ValueError(
            f"{name} needs an action space, such as env.action_space, or mjx_reinforce.Box(low, "
            f"high) with arrays [A], got a {type(space).__name__}"
        )


def continuous_box(name: str, space: Box | Discrete, *, bounded: bool = False) -> Box:
    """Returns the action space if it is continuous.

    Args:
      name: the family's name, for the message.
      space: the action space.
      bounded: whether all its bounds must be finite.

    Raises:
      ValueError: the space is discrete, or an entry is unbounded.
    """
    check_space(name, space)
    if not isinstance(space, Box):
        raise ValueError(
            f"{name} needs a continuous action space, this one is discrete; choose categorical"
        )
    if bounded and not np.all(np.isfinite(space.low) & np.isfinite(space.high)):
        raise ValueError(
            f"{name} needs finite action bounds, got {space}; "
            "choose normal, or declare bounds in the environment's action_space"
        )
    return space


def middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centre and half the width of each entry's range, [A] each.

    They are 0 and 1 for an entry that is not bounded on both sides.
    """
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2
