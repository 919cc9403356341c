"""The Normal distribution, with a trained or a state-dependent standard deviation."""

import jax.numpy as jnp

from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.distributions.gaussian import (
    gaussian_outputs,
    normal_entropy,
    normal_kl,
    normal_log_density,
)
from mjx_reinforce.types import Box, Discrete


def normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, unbounded.

    The mean is the middle of the action's range plus half the range times the
    network's output, so that outputs between -1 and 1 cover the range; in an unbounded
    entry the mean is the output itself. Samples may fall outside the bounds, and the
    environment decides what then happens (MuJoCo clamps them in the actuator).

    Args:
      space: the action bounds, [A] each.
      std: "parameter" for one trained log-std an entry, the same in all states
        (Schulman et al. 2015, arXiv:1502.05477); "softplus" for log(1 + exp(o))
        of a second network output (Gymnasium's REINFORCE tutorial); "sigmoid" for
        1 / (1 + exp(-o)), which stays below 1.
      initial_std: the standard deviation before training, in the action's unit.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    base = gaussian_outputs("normal", space, std, initial_std, rescale)

    def sample(outputs, noise):
        mean, scale = base.split(outputs)
        return mean + scale * noise

    def log_prob(outputs, action):
        return jnp.sum(normal_log_density(action, *base.split(outputs)), axis=-1)

    def entropy(outputs):
        return jnp.sum(normal_entropy(base.split(outputs)[1]), axis=-1)

    def kl(outputs, others):
        return jnp.sum(normal_kl(*base.split(outputs), *base.split(others)), axis=-1)

    def mode(outputs):
        return base.split(outputs)[0]

    def fisher(constants):
        return jnp.concatenate([(base.half * jnp.exp(-constants)) ** 2, 2.0 + 0.0 * constants])

    distribution = base.distribution(sample, mode, log_prob, entropy, kl=kl)
    return distribution._replace(fisher=fisher) if std == "parameter" else distribution


def normal_softplus(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent softplus standard deviation."""
    return normal(space, std="softplus", initial_std=initial_std, rescale=rescale)


def normal_sigmoid(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent sigmoid standard deviation, below 1."""
    return normal(space, std="sigmoid", initial_std=initial_std, rescale=rescale)
