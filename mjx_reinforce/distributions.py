"""Action distributions, indexed by the outputs of a policy network.

A distribution is a tuple of pure functions. ``outputs`` [..., K] holds its
parameters: first ``num_outputs`` entries that the network computes from the
observation, then one for each of ``constants``, trained but the same in every
state. Sampling is split in two, ``noise`` and ``sample``, so that every engine
draws the same actions from the same key: noise may be drawn far from where it
is used.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.types import Box

_LOG_SQRT_2PI = 0.5 * float(np.log(2.0 * np.pi))
_MIN_STD = 1e-6


class Distribution(NamedTuple):
    """A family of distributions over actions.

    num_outputs: entries of ``outputs`` that the network computes
    constants: [K - num_outputs] initial values of the entries no state changes
    noise: (key, shape) -> [*shape, E] what ``sample`` transforms; consumes the key
    sample: (outputs [..., K], noise [..., E]) -> action [..., A]
    mode: (outputs [..., K]) -> action [..., A], the deterministic policy
    log_prob: (outputs [..., K], action [..., A]) -> [...], summed over entries
    entropy: (outputs [..., K]) -> [...], in nats
    """

    num_outputs: int
    constants: tuple[float, ...]
    noise: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    sample: Callable[[jax.Array, jax.Array], jax.Array]
    mode: Callable[[jax.Array], jax.Array]
    log_prob: Callable[[jax.Array, jax.Array], jax.Array]
    entropy: Callable[[jax.Array], jax.Array]


def normal(space: Box, *, std: str = "parameter", initial_std: float = 0.5) -> Distribution:
    """An independent Normal in each entry, unbounded.

    The mean is the middle of the action's range plus half the range times the
    network's output, so that an output of order one uses the range; unbounded
    entries are taken as they are. Samples may fall outside the bounds: the
    environment, not the policy, decides what that means (MuJoCo clamps inside
    the actuator).

    Args:
      space: the action bounds, [A] each.
      std: "parameter" for one trained log-std an entry, the same in all states
        (Schulman et al. 2015, arXiv:1502.05477); "softplus" for log(1 + exp(o))
        of a second network output (Gymnasium's REINFORCE tutorial).
      initial_std: the standard deviation before training, in the action's unit.

    Returns:
      The distribution, with A ("parameter") or 2A ("softplus") network outputs.

    Raises:
      ValueError: ``std`` is unknown or ``initial_std`` is not positive.
    """
    if std not in ("parameter", "softplus"):
        raise ValueError(f"std must be 'parameter' or 'softplus', got {std!r}")
    if not (np.isfinite(initial_std) and initial_std > 0):
        raise ValueError(f"initial_std must be positive and finite, got {initial_std}")
    size = len(space.low)
    middle, half = _middle_and_half_range(space)
    # softplus(o + shift) equals initial_std at o = 0, where a fresh network starts.
    shift = float(np.log(np.expm1(initial_std)))

    def split(outputs):
        mean = outputs[..., :size] * half + middle
        raw = outputs[..., size:]
        if std == "parameter":
            return mean, jnp.exp(raw)
        return mean, jax.nn.softplus(raw + shift) + _MIN_STD

    def sample(outputs, noise):
        mean, scale = split(outputs)
        return mean + scale * noise

    def log_prob(outputs, action):
        mean, scale = split(outputs)
        score = (action - mean) / scale
        return jnp.sum(-0.5 * score**2 - jnp.log(scale) - _LOG_SQRT_2PI, axis=-1)

    def entropy(outputs):
        _, scale = split(outputs)
        return jnp.sum(jnp.log(scale) + 0.5 + _LOG_SQRT_2PI, axis=-1)

    return Distribution(
        num_outputs=size if std == "parameter" else 2 * size,
        constants=(float(np.log(initial_std)),) * size if std == "parameter" else (),
        noise=lambda key, shape: jax.random.normal(key, (*shape, size)),
        sample=sample,
        mode=lambda outputs: split(outputs)[0],
        log_prob=log_prob,
        entropy=entropy,
    )


def normal_softplus(space: Box, *, initial_std: float = 0.5) -> Distribution:
    """``normal`` with a state-dependent softplus standard deviation."""
    return normal(space, std="softplus", initial_std=initial_std)


def _middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centre and half the width of each bounded entry, 0 and 1 for the others."""
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2
