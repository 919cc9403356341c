"""Diagnostics: how an update changed the policy, and how noisy the gradient was that it followed.

Only ``within_kl`` changes what is learned. The diagnostics cost a few percent of an update
at most: the policies are compared at a few of the visited steps, and the noise is that of a few
episodes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from optax import Params

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
        return jnp.sum(jnp.where(self.weight > 0, self.weight * values, 0.0))


def visited_steps(trajectory: Trajectory) -> Visited:
    """Returns at most ``MAX_COMPARED`` steps; all of them, if each episode has at most K.

    Of an episode of L steps, every s-th is taken, from the middle of the first s on, with s = L / K
    rounded up. Together they count as L. Of more than ``MAX_COMPARED`` episodes, every second,
    third, ... is taken.
    """
    apart = slice(None, None, -(-trajectory.mask.shape[1] // MAX_COMPARED))
    mask = trajectory.mask[:, apart]
    horizon, num_episodes = mask.shape
    each = min(horizon, MAX_COMPARED // num_episodes)
    length = jnp.sum(mask, axis=0)
    stride = jnp.maximum(-(-length // each), 1)
    time = stride // 2 + stride * jnp.arange(each)[:, None]
    inside = time < length
    share = jnp.where(inside, length / jnp.maximum(jnp.sum(inside, axis=0), 1), 0.0)

    def take(x):
        index = jnp.minimum(time, horizon - 1).reshape(each, num_episodes, *(1,) * (x.ndim - 2))
        return jnp.take_along_axis(x[:, apart], index, axis=0)

    return Visited(
        observation=take(trajectory.observation),
        action=take(trajectory.action),
        weight=share / jnp.maximum(jnp.sum(length), 1),
    )


def policy_metrics(policy: Policy, before: Actor, after: Actor, visited: Visited) -> Metrics:
    """Returns what an update made of a policy, means [] over visited steps.

    ``kl`` is that of ``kl_divergence`` in nats; it counts what the observations' new scale does to
    the policy, too. ``policy_std`` is the standard deviation before the update, in the action's
    unit, the mean over its entries; a family that has none has no such metric.
    """
    old = act(policy, before, visited.observation)
    new = act(policy, after, visited.observation)
    kl = kl_divergence(policy.distribution, old, new, visited.action)
    metrics = {"kl": visited.mean(kl)}
    if policy.distribution.std is not None:
        std = jnp.mean(policy.distribution.std(old), axis=-1)
        metrics["policy_std"] = visited.mean(std)
    return metrics


def within_kl(
    policy: Policy, actor: Actor, params: Params, visited: Visited, max_kl: float | jax.Array | None
) -> Any:
    """Returns the parameters on the straight way to ``params`` at which KL is about ``max_kl``.

    Where KL(before || after), the mean over visited steps, is greater than that, the change is
    multiplied by sqrt(max_kl / KL): KL grows as the square of a small change (as in the natural
    gradient's step, Schulman et al. 2015, arXiv:1502.05477, appendix C, without its line search).
    Its direction stays.

    Args:
      policy: whose parameters change.
      actor: the policy before the change.
      params: the parameters after it.
      visited: where the two are compared.
      max_kl: in nats; None limits nothing.
    """
    if max_kl is None:
        return params
    changed = actor.replace(params=params)
    kl = policy_metrics(policy, actor, changed, visited)["kl"]
    share = jnp.where(kl > max_kl, jnp.sqrt(max_kl / kl), 1.0)
    return jax.tree.map(lambda old, new: old + share * (new - old), actor.params, params)


def kl_divergence(
    distribution: Distribution, old: jax.Array, new: jax.Array, action: jax.Array
) -> jax.Array:
    """Returns KL(old || new) [...] in nats: exactly, or estimated from an action of the old one.

    The estimate is k3 = r - 1 - log r with r = new(a) / old(a). It is never negative, and for an
    action a that the new policy does not depend on it is unbiased, since E[r] = 1 (Schulman 2020,
    "Approximating KL Divergence", http://joschu.net/blog/kl-approx.html). The actions here have
    shaped the new policy, which biases the estimate by an order of 1 / the steps of the update.

    Args:
      distribution: the family of both.
      old: its parameters [..., K] before the update.
      new: its parameters after it.
      action: [..., A] drawn from the old one; not read where the family knows its ``kl``.
    """
    if distribution.kl is not None:
        return distribution.kl(old, new)
    log_ratio = distribution.log_prob(new, action) - distribution.log_prob(old, action)
    return jnp.expm1(log_ratio) - log_ratio
