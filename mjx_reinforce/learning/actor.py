"""What a policy needs to act: its parameters and the statistics that scale its observations."""

from typing import Any

import jax
from flax import struct

from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.policy import Policy


class Actor(struct.PyTreeNode, kw_only=True):
    """All that playing needs.

    Attributes:
      params: the policy's parameters
      normalizer: the statistics that scale its observations

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env)
      >>> actor = learner.init(jax.random.key(0)).actor
      >>> mr.act(learner.policy, actor, jax.numpy.zeros((5, 4))).shape
      (5, 2)
    """

    params: Any
    normalizer: normalize.Normalizer

    def __repr__(self) -> str:
        count = sum(x.size for x in jax.tree.leaves(self.params))
        return f"Actor({count:,} parameters, {self.normalizer!r})"


def act(policy: Policy, actor: Actor, observation: jax.Array) -> jax.Array:
    """Returns the parameters of the action distribution for each observation.

    Args:
      policy: the network and its distribution.
      actor: the policy's parameters and the observation statistics.
      observation: [..., O] as the environment returned it, not yet scaled.

    Returns:
      The outputs [..., K]: ``policy.distribution.mode(outputs)`` is the deterministic
      action, ``policy.distribution.sample(outputs, noise)`` a random one.

    Raises:
      ValueError: an argument is of another type, or the observation of another size.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env)
      >>> actor = learner.init(jax.random.key(0)).actor
      >>> mr.act(learner.policy, actor, jax.numpy.zeros((5, 4))).shape
      (5, 2)
    """
    check_kind("policy", policy, Policy, "learner.policy")
    check_kind("actor", actor, Actor, "state.actor")
    size = actor.normalizer.mean.shape[-1]
    if observation.shape[-1:] != (size,):
        raise ValueError(
            f"the observation must be [..., {size}], got one of shape {list(observation.shape)}"
        )
    return policy.apply(actor.params, normalize.apply(actor.normalizer, observation))
