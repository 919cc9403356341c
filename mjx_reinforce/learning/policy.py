"""Policies: a network from observations to the parameters of a distribution, and who acts by it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import check_count, check_kind, check_name, check_type
from mjx_reinforce.engine.play import units
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import Distribution

#: The ways to draw initial weights.
INITIALIZERS = ("orthogonal", "torch")


class MLP(nn.Module):
    """A multilayer perceptron with tanh units and a linear last layer.

    hidden_sizes: units of each hidden layer; none for a linear function
    num_outputs: entries of the output
    output_scale: gain of the last layer's orthogonal initial weights; with 0.01 an
      untrained policy does nearly the same in all states (Andrychowicz et al. 2020,
      arXiv:2006.05990, section 3.2)
    initializer: "orthogonal": orthogonal weights in the last layer, LeCun's normal
      weights in the hidden layers, zero biases; "torch": all weights and biases
      uniform within 1 / sqrt(fan-in), as in ``torch.nn.Linear``, and ``output_scale``
      is not used
    precision: of products. ``DEFAULT`` is TF32 on NVIDIA's GPUs: with it, small policies fail to
      learn and nothing reports it
    """

    hidden_sizes: Sequence[int]
    num_outputs: int
    output_scale: float = 1.0
    initializer: str = "orthogonal"
    precision: jax.lax.Precision = jax.lax.Precision.HIGHEST

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Returns [..., num_outputs] of ``x`` [..., O]; ValueError: unknown initializer."""
        check_name("initializer", self.initializer, dict.fromkeys(INITIALIZERS))
        # Written out as scalar code, a network is a loop over its units: see ``units``.
        if units.wanted(x) and not self.is_initializing():
            params = self.variables["params"]
            return units.tanh_network([params[f"Dense_{i}"] for i in range(len(params))], x)
        for size in self.hidden_sizes:
            x = nn.tanh(self._dense(x, size, nn.initializers.lecun_normal()))
        return self._dense(x, self.num_outputs, nn.initializers.orthogonal(self.output_scale))

    def _dense(self, x: jax.Array, size: int, kernel_init: nn.initializers.Initializer):
        bias_init = nn.initializers.zeros
        # PyTorch draws biases from the same range as weights, by the layer's inputs.
        if self.initializer == "torch":
            kernel_init = bias_init = _symmetric_uniform(x.shape[-1] ** -0.5)
        options = {"kernel_init": kernel_init, "bias_init": bias_init, "precision": self.precision}
        return nn.Dense(size, **options)(x)


def _symmetric_uniform(bound: float) -> nn.initializers.Initializer:
    """Returns an initializer that draws from the uniform distribution on (-bound, bound)."""

    def draw(key, kernel_shape, dtype=float, out_sharding=None):
        del out_sharding  # of the signature of JAX's initializers
        return jax.random.uniform(key, kernel_shape, dtype, -bound, bound)

    return draw


class Policy(NamedTuple):
    """A parametrized distribution over actions, given the observation.

    Attributes:
      init: (key) -> params; consumes the key
      apply: (params, observation [..., O]) -> outputs [..., K] of ``distribution``: the
        ``num_outputs`` entries that a network computes, then one for each of
        ``distribution.constants``, which are parameters; ``normal`` has a log standard deviation
        for each entry of the action. ``mlp_policy`` is an example
      distribution: the family of distributions that the outputs are the parameters of

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> policy = mr.mlp_policy(env.observation_size, mr.categorical(env.action_space), (8,))
      >>> params = policy.init(jax.random.key(0))
      >>> policy.apply(params, jax.numpy.zeros((5, 4))).shape  # a logit for each action
      (5, 2)
    """

    init: Callable[[jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]
    distribution: Distribution

    def __repr__(self) -> str:
        return f"Policy({self.distribution!r})"


def mlp_policy(
    observation_size: int,
    distribution: Distribution,
    hidden_sizes: Sequence[int] = (32, 32),
    *,
    initializer: str = "orthogonal",
) -> Policy:
    """Builds a policy whose distribution has its parameters from an MLP with tanh units.

    Args:
      observation_size: O.
      distribution: the family whose parameters the network computes.
      hidden_sizes: units of each hidden layer; empty for a linear policy.
      initializer: of the weights, see ``MLP``.

    Returns:
      The policy; its params are ``{"network": ..., "constants": [K - num_outputs]}``.

    Raises:
      ValueError: a layer has no units, or the initializer is unknown.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> policy = mr.mlp_policy(env.observation_size, mr.categorical(env.action_space), (8,))
      >>> params = policy.init(jax.random.key(0))
      >>> policy.apply(params, jax.numpy.zeros((5, 4))).shape  # a logit for each action
      (5, 2)
    """
    check_count("observation_size", observation_size)
    check_kind("distribution", distribution, Distribution, "mjx_reinforce.normal(env.action_space)")
    check_type("hidden_sizes", hidden_sizes, tuple[int, ...])
    if any(size < 1 for size in hidden_sizes):
        raise ValueError(f"every hidden layer needs at least one unit, got {hidden_sizes}")
    check_name("initializer", initializer, dict.fromkeys(INITIALIZERS))
    # With small last weights an untrained policy does nearly the same everywhere, see ``MLP``.
    network = MLP(tuple(hidden_sizes), distribution.num_outputs, 0.01, initializer)
    constants = distribution.constants

    def init(key):
        params = network.init(key, jnp.zeros(observation_size))
        return {"network": params, "constants": jnp.asarray(constants, jnp.result_type(float))}

    def apply(params, observation):
        outputs = jnp.asarray(network.apply(params["network"], observation))
        # The same for all observations, and parameters still: the gradient sums over the steps.
        constants_shape = (*outputs.shape[:-1], len(constants))
        constant_outputs = jnp.broadcast_to(params["constants"], constants_shape)
        return jnp.concatenate([outputs, constant_outputs], axis=-1)

    return Policy(init, apply, distribution)


def within_bounds(policy: Policy, space: Box | Discrete) -> Policy:
    """Returns a policy that is played within the bounds of the action space.

    Its mode is clipped, and its distribution knows how to ``clip`` what is drawn. Samples are not
    clipped themselves: training learns from them (docs/settings.md says why).
    """
    if isinstance(space, Discrete) or not np.isfinite([space.low, space.high]).any():
        return policy

    def clip(action: jax.Array) -> jax.Array:
        return jnp.clip(action, *(jnp.asarray(bound, action.dtype) for bound in space))

    # The sample and its log-probability stay those of the family: a clipped action would have the
    # probability of a whole tail, and the score of the density would be wrong for it.
    family = policy.distribution
    clipped_family = family._replace(mode=lambda outputs: clip(family.mode(outputs)), clip=clip)
    return policy._replace(distribution=clipped_family)


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
        num_params = sum(x.size for x in jax.tree.leaves(self.params))
        return f"Actor({num_params:,} parameters, {self.normalizer!r})"


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
