"""The clipped Normal: a Normal whose samples are clipped to the action's range."""

import jax
import jax.numpy as jnp

from mjx_reinforce.policies.distributions.action_range import bounds, finite_box
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.distributions.gaussian import (
    LOG_SQRT_2PI,
    gaussian_outputs,
    normal_entropy,
    normal_log_density,
)
from mjx_reinforce.policies.distributions.normal_integrals import log_tail
from mjx_reinforce.types import Box, Discrete


def clipped_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, clipped to the action's range.

    The environment sees only the clipped action, so ``log_prob`` is the log of that
    action's probability: the Normal's density inside the range, and at a bound the
    probability of everything that is clipped to it. The gradient has the same mean as
    that of ``normal`` and less variance (Fujita and Maeda 2018, arXiv:1802.07564,
    equation 8). ``entropy`` is that of the clipped action, -E[log_prob].

    Args:
      space: the action bounds, [A] each, finite.
      std: as in ``normal``, of the Normal before it is clipped.
      initial_std: as in ``normal``.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.clipped_normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    base = gaussian_outputs("clipped-normal", space, std, initial_std, rescale)
    box = finite_box("clipped-normal", space)

    def sample(outputs, noise):
        mean, scale = base.split(outputs)
        return jnp.clip(mean + scale * noise, *bounds(box, outputs))

    def mode(outputs):
        return jnp.clip(base.split(outputs)[0], *bounds(box, outputs))

    def log_prob(outputs, action):
        mean, scale = base.split(outputs)
        low, high = bounds(box, outputs)
        inside = normal_log_density(action, mean, scale)
        below, above = log_tail((mean - low) / scale), log_tail((high - mean) / scale)
        value = jnp.where(action <= low, below, jnp.where(action >= high, above, inside))
        return jnp.sum(value, axis=-1)

    def entropy(outputs):
        mean, scale = base.split(outputs)
        return jnp.sum(_clipped_entropy(mean, scale, *bounds(box, outputs)), axis=-1)

    return base.distribution(sample, mode, log_prob, entropy)


def _clipped_entropy(mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Returns the entropy [...] of a clipped Normal in nats, entry by entry.

    Inside the range -log_prob is x^2 / 2 + log(std sqrt(2 pi)) with x = (action - mean) / std.
    With a and b the bounds in this unit, phi the standard Normal's density and P the probability
    of [a, b], the integral of x^2 phi(x) from a to b is P + a phi(a) - b phi(b). Each bound adds
    -p log p, with p the probability of what is clipped to it.
    """
    a, b = (low - mean) / std, (high - mean) / std
    log_below, log_above = log_tail(-a), log_tail(b)
    below, above = jnp.exp(log_below), jnp.exp(log_above)
    edges = b * jnp.exp(-0.5 * b**2 - LOG_SQRT_2PI) - a * jnp.exp(-0.5 * a**2 - LOG_SQRT_2PI)
    inside = (1.0 - below - above) * normal_entropy(std) - 0.5 * edges
    return inside - below * log_below - above * log_above
