"""The truncated Normal: a Normal restricted to the action's range."""

import jax
import jax.numpy as jnp

from mjx_reinforce.policies.distributions import normal_integrals
from mjx_reinforce.policies.distributions.action_range import bounds, finite_box
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.distributions.gaussian import gaussian_outputs
from mjx_reinforce.types import Box, Discrete


def truncated_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, restricted to the action's range.

    Density, entropy and their gradients stay exact when the mean is far outside the
    range, and so does the sampling, by the inverse distribution function; see
    ``mjx_reinforce.policies.distributions.normal_integrals``. The noise is uniform in (0, 1).

    Args:
      space: the action bounds, [A] each, finite.
      std: as in ``normal``, of the Normal before it is restricted.
      initial_std: as in ``normal``.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.truncated_normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    base = gaussian_outputs("truncated-normal", space, std, initial_std, rescale)
    box = finite_box("truncated-normal", space)

    def restricted(outputs):
        return *base.split(outputs), *bounds(box, outputs)

    def sample(outputs, noise):
        return normal_integrals.transform(noise, *restricted(outputs))

    def mode(outputs):
        mean, _, low, high = restricted(outputs)
        return jnp.clip(mean, low, high)

    def log_prob(outputs, action):
        return jnp.sum(normal_integrals.log_density(action, *restricted(outputs)), axis=-1)

    def entropy(outputs):
        return jnp.sum(normal_integrals.entropy(*restricted(outputs)), axis=-1)

    return base.distribution(sample, mode, log_prob, entropy, noise=_open_uniform)


def _open_uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns uniform noise that is never 0 or 1.

    The generator returns multiples of the dtype's epsilon, 0 among them; half an
    epsilon is added.
    """
    noise = jax.random.uniform(key, shape)
    return noise + 0.5 * jnp.finfo(noise.dtype).eps
