"""The deterministic policy, as a distribution of a single point."""

import jax.numpy as jnp

from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.distributions.gaussian import gaussian_outputs
from mjx_reinforce.types import Box, Discrete


def deterministic(
    space: Box | Discrete, *, initial_std: float | None = None, rescale: bool = True
) -> Distribution:
    """A single point: the action is the network's output, rescaled like the mean of ``normal``.

    It is for methods that need no likelihood, such as ``ars``: ``log_prob`` raises
    ValueError.

    Args:
      space: the action bounds, [A] each.
      initial_std: not used; every family takes it.
      rescale: False takes the network's output as the action itself.

    Returns:
      The distribution, with A network outputs.

    Raises:
      ValueError: the space is discrete.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.deterministic(mr.Box(-2 * np.ones(1), 2 * np.ones(1)))
      >>> family.mode(jnp.ones(1)).tolist()  # 1 is the end of the range
      [2.0]
    """
    del initial_std
    base = gaussian_outputs("deterministic", space, "parameter", 1.0, rescale)

    def log_prob(outputs, action):
        raise ValueError(
            "a deterministic policy has no log-probability; choose a stochastic one for REINFORCE"
        )

    return Distribution(
        num_outputs=base.size,
        constants=(),
        noise=lambda key, shape: jnp.zeros((*shape, 1)),
        sample=lambda outputs, noise: base.mean(outputs),
        mode=base.mean,
        log_prob=log_prob,
        entropy=lambda outputs: jnp.zeros(outputs.shape[:-1], outputs.dtype),
    )
