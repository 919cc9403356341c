"""Diagnostics: how an update changed the policy.

They change nothing of what is learned (``trust_region`` limits a change by the KL divergence that
is defined here; how noisy the gradient was is in ``updates``), and cost a few percent of an update
at most: the policies are compared at a few of the visited steps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Trajectory
from mjx_reinforce.learning.distributions import Distribution
from mjx_reinforce.learning.policy import Actor, Policy, act

Metrics = dict[str, jax.Array]

#: The policies before and after an update are compared at so many visited steps at most.
MAX_COMPARED = 64


class Visited(NamedTuple):
    """K steps of each of M episodes, evenly apart.

    observation: [K, M, O]
    action: [K, M, ...]
    weight: [K, M] the share of all steps of the M episodes that each stands for; they sum to 1
    """

    observation: jax.Array
    action: jax.Array
    weight: jax.Array

    def mean(self, values: jax.Array) -> jax.Array:
        """Returns the mean [] of values [K, M] over the visited steps."""
        # ``where`` besides the weight: beyond an episode's end a value may be NaN.
        return jnp.sum(jnp.where(self.weight > 0, self.weight * values, 0.0))


def visited_steps(trajectory: Trajectory) -> Visited:
    """Returns at most ``MAX_COMPARED`` steps; all of them, if each episode has at most K.

    Of an episode of L steps, every s-th is taken, from the middle of the first s on, with s = L / K
    rounded up. Together they count as L. Of more than ``MAX_COMPARED`` episodes, every second,
    third, ... is taken.
    """
    # Every s-th of the N episodes, s rounded up, so that M of them, at most MAX_COMPARED, remain.
    episodes = slice(None, None, -(-trajectory.mask.shape[1] // MAX_COMPARED))
    mask = trajectory.mask[:, episodes]
    horizon, num_episodes = mask.shape
    num_steps = min(horizon, MAX_COMPARED // num_episodes)

    # The stride [M] in time depends on how long an episode was, so times are [K, M] and traced.
    length = jnp.sum(mask, axis=0)
    stride = jnp.maximum(-(-length // num_steps), 1)
    step_index = stride // 2 + stride * jnp.arange(num_steps)[:, None]

    # The steps taken of an episode share its length, so that a long episode counts for more, as it
    # does in the mean over all steps. A short episode has fewer than K; the rest have weight 0.
    is_played = step_index < length
    step_weight = jnp.where(is_played, length / jnp.maximum(jnp.sum(is_played, axis=0), 1), 0.0)

    def take(x):
        """Returns [K, M, ...] of an array [T, N, ...]; where the weight is 0, of any step."""
        entry_axes = (1,) * (x.ndim - 2)
        index = jnp.minimum(step_index, horizon - 1).reshape(num_steps, num_episodes, *entry_axes)
        return jnp.take_along_axis(x[:, episodes], index, axis=0)

    return Visited(
        observation=take(trajectory.observation),
        action=take(trajectory.action),
        weight=step_weight / jnp.maximum(jnp.sum(length), 1),
    )


def policy_metrics(policy: Policy, old_actor: Actor, new_actor: Actor, visited: Visited) -> Metrics:
    """Returns what an update made of a policy, means [] over visited steps.

    ``kl`` is that of ``kl_divergence`` in nats; it counts what the observations' new scale does to
    the policy, too. ``policy_std`` is the standard deviation before the update, in the action's
    unit, the mean over its entries; a family that has none has no such metric.
    """
    # Both read the raw observations, each in the scale that it has itself.
    old_outputs = act(policy, old_actor, visited.observation)
    new_outputs = act(policy, new_actor, visited.observation)
    kl = kl_divergence(policy.distribution, old_outputs, new_outputs, visited.action)
    metrics = {"kl": visited.mean(kl)}
    if policy.distribution.std is not None:
        std = jnp.mean(policy.distribution.std(old_outputs), axis=-1)
        metrics["policy_std"] = visited.mean(std)
    return metrics


def kl_divergence(
    distribution: Distribution, old_outputs: jax.Array, new_outputs: jax.Array, action: jax.Array
) -> jax.Array:
    """Returns KL(old || new) [...] in nats: exactly, or estimated from an action of the old one.

    The estimate is k3 = r - 1 - log r with r = new(a) / old(a). It is never negative, and for an
    action a that the new policy does not depend on it is unbiased, since E[r] = 1 (Schulman 2020,
    "Approximating KL Divergence", http://joschu.net/blog/kl-approx.html). The actions here have
    shaped the new policy, which biases the estimate by an order of 1 / the steps of the update.

    Args:
      distribution: the family of both.
      old_outputs: its parameters [..., K] before the update.
      new_outputs: its parameters after it.
      action: [..., A] drawn from the old one; not read where the family knows its ``kl``.
    """
    if distribution.kl is not None:
        return distribution.kl(old_outputs, new_outputs)
    # r - 1 as expm1(log r): near r = 1, where updates are small, r - 1 would cancel.
    log_ratio = distribution.log_prob(new_outputs, action) - distribution.log_prob(
        old_outputs, action
    )
    return jnp.expm1(log_ratio) - log_ratio
