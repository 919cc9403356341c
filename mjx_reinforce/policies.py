"""Policies: a network from observations to the parameters of an action distribution."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.distributions import Distribution
from mjx_reinforce.networks import MLP


class Policy(NamedTuple):
    """A parametrised distribution over actions, given the observation.

    init: (key) -> params; consumes the key
    apply: (params, observation [..., O]) -> outputs [..., K] of ``distribution``
    distribution: what the outputs index
    """

    init: Callable[[jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]
    distribution: Distribution


def mlp_policy(
    observation_size: int, distribution: Distribution, hidden_sizes: Sequence[int] = (32, 32)
) -> Policy:
    """A policy whose distribution is indexed by an MLP with tanh units.

    Args:
      observation_size: O.
      distribution: what the network's outputs index.
      hidden_sizes: units of each hidden layer; empty for a linear policy.

    Returns:
      The policy; its params are ``{"network": ..., "constants": [K - num_outputs]}``.

    Raises:
      ValueError: a layer has no units.
    """
    if any(size < 1 for size in hidden_sizes):
        raise ValueError(f"every hidden layer needs at least one unit, got {tuple(hidden_sizes)}")
    network = MLP(tuple(hidden_sizes), distribution.num_outputs, output_scale=0.01)
    constants = distribution.constants

    def init(key):
        return {
            "network": network.init(key, jnp.zeros(observation_size)),
            "constants": jnp.asarray(constants, jnp.result_type(float)),
        }

    def apply(params, observation):
        outputs = jnp.asarray(network.apply(params["network"], observation))
        fixed = jnp.broadcast_to(params["constants"], (*outputs.shape[:-1], len(constants)))
        return jnp.concatenate([outputs, fixed], axis=-1)

    return Policy(init, apply, distribution)
