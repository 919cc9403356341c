"""The categorical distribution, for discrete action spaces."""

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.learning.distributions.distribution import Distribution, check_space


def categorical(
    space: Box | Discrete, *, initial_std: float | None = None, rescale: bool = True
) -> Distribution:
    """A softmax over the actions of a discrete space; an action is an int32 [...].

    The noise is Gumbel. The sample is the action with the greatest sum of logit and
    noise (Maddison et al. 2014, "A* sampling").

    Args:
      space: the number of actions.
      initial_std: not used; every family takes it.
      rescale: not used; every family takes it.

    Returns:
      The distribution, with a logit for each action as network outputs.

    Raises:
      ValueError: the space is continuous.

    Examples:
      >>> import jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> family = mr.categorical(mr.Discrete(2))
      >>> family.mode(jnp.asarray([0.0, 1.0])).item()
      1
    """
    del initial_std, rescale
    check_space("categorical", space)
    if not isinstance(space, Discrete):
        raise ValueError(
            "categorical needs a discrete action space, this one is continuous; choose normal"
        )
    size = space.num_actions

    def greatest(scores):
        return jnp.argmax(scores, axis=-1).astype(jnp.int32)

    def log_prob(outputs, action):
        chosen = jnp.arange(size) == action[..., None]
        return jnp.sum(jnp.where(chosen, jax.nn.log_softmax(outputs), 0.0), axis=-1)

    def entropy(outputs):
        log_probs = jax.nn.log_softmax(outputs)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    def kl(outputs, others):
        log_probs = jax.nn.log_softmax(outputs)
        apart = log_probs - jax.nn.log_softmax(others)
        return jnp.sum(jnp.exp(log_probs) * apart, axis=-1)

    return Distribution(
        num_outputs=size,
        constants=(),
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, size)),
        sample=lambda outputs, noise: greatest(outputs + noise),
        mode=greatest,
        log_prob=log_prob,
        entropy=entropy,
        kl=kl,
    )
