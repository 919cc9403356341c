"""Diagnostics: how an update changed the policy, and how noisy the gradient was that it followed.

Only ``within_kl`` changes what is learned. The diagnostics cost a few percent of an update
at most: the policies are compared at a few of the visited steps, and the noise is that of a few
episodes.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from mjx_reinforce.engine.base import Trajectory
from mjx_reinforce.engine.episode import while_any
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import Distribution
from mjx_reinforce.learning.policy import Actor, Policy, act

Metrics = dict[str, jax.Array]

#: The policies before and after an update are compared at so many visited steps at most.
MAX_COMPARED = 64
#: A change that is shortened has so much of the limit of KL at least and at most, and is aimed at
#: so much where the first share that is tried does not fit.
_ENOUGH, _MOST, _AIM = 0.5, 1.01, 0.95
#: The search for the share of a change ends here.
_LEAST_SHARE, _MOST_TRIED = 1e-30, 40


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
    policy: Policy, before: Actor, after: Actor, visited: Visited, max_kl: float | jax.Array | None
) -> Actor:
    """Returns the actor on the straight way from ``before`` to ``after`` that KL allows.

    A change whose KL(before || after), the mean over visited steps, is greater than ``max_kl`` is
    shortened as a whole, the parameters and the scale of the observations alike. KL grows as the
    square of a small change, so the first share that is tried is sqrt(max_kl / KL) (as in the
    natural gradient's step, Schulman et al. 2015, arXiv:1502.05477, appendix C). Where that goes
    too far, or far less than it may, shares are tried between those that are known to be too small
    and too large, in the logarithm of the share. Its direction stays.

    Args:
      policy: whose actor changes.
      before: the actor that played.
      after: the one that is proposed.
      visited: where the two are compared.
      max_kl: in nats; None limits nothing.

    Returns:
      An actor within the limit, to a hundredth of it. Where no share of the change is, its
      parameters are NaN, for ``keep_finite`` to see; but an untrained policy, whose observations
      were not scaled so far, takes the first scale and nothing else.
    """
    if max_kl is None:
        return after
    old = act(policy, before, visited.observation)

    def along(share: jax.Array) -> Actor:
        def blend(start: jax.Array, end: jax.Array) -> jax.Array:
            return start + share * (end - start)

        return Actor(
            params=jax.tree.map(blend, before.params, after.params),
            normalizer=normalize.between(before.normalizer, after.normalizer, share),
        )

    def kl_of(actor: Actor) -> jax.Array:
        new = act(policy, actor, visited.observation)
        kl = visited.mean(kl_divergence(policy.distribution, old, new, visited.action))
        return jnp.where(jnp.isfinite(kl), kl, jnp.inf)  # what overflows is beyond any limit

    whole = kl_of(after)
    share = jnp.sqrt(max_kl / whole)
    share = jnp.where(share > _LEAST_SHARE, share, _LEAST_SHARE**0.5)
    first = jnp.where(whole <= max_kl, 1.0, share)
    share = _share_within(lambda share: kl_of(along(share)), first, max_kl)
    limited = along(share)
    # The first scale also clips, which no share of it does less. It then comes alone and whole.
    fresh = jnp.isnan(share) & (before.normalizer.count == 0) & (after.normalizer.count > 0)
    fresh &= jnp.all(jnp.isfinite(ravel_pytree(after.params)[0]))
    params = jax.tree.map(
        lambda old, new: jnp.where(fresh, old, new), before.params, limited.params
    )
    return limited.replace(params=params)


class _Tried(NamedTuple):
    """A share [] of a change that was tried, and what is known of others.

    share: the last that was tried
    kl: that of the policies before the change and after this share of it
    within: the greatest share that is known to be within the limit
    beyond: the least that is known to be beyond it
    tries: how many were tried
    """

    share: jax.Array
    kl: jax.Array
    within: jax.Array
    beyond: jax.Array
    tries: jax.Array


def _share_within(
    kl_at: Callable[[jax.Array], jax.Array], first: jax.Array, max_kl: float | jax.Array
) -> jax.Array:
    """Returns a share [] of a change whose KL is within the limit, or NaN if none was found.

    Args:
      kl_at: share -> KL, infinite where it overflows.
      first: the share that is tried first. 1 is taken as it is.
      max_kl: in nats.
    """

    def fits(tried: _Tried) -> jax.Array:
        enough = (tried.kl >= _ENOUGH * max_kl) & (tried.kl <= _MOST * max_kl)
        return enough | (tried.share == 1.0)

    def unfinished(tried: _Tried) -> jax.Array:
        return ~fits(tried) & (tried.tries < _MOST_TRIED)

    def body(tried: _Tried) -> _Tried:
        below = tried.kl <= _MOST * max_kl
        within = jnp.where(below, tried.share, tried.within)
        beyond = jnp.where(below, tried.beyond, tried.share)
        # Where KL is no square of the share, every second one halves what is left.
        square = tried.share * jnp.sqrt(_AIM * max_kl / tried.kl)
        usable = (square > within) & (square < beyond) & (tried.tries % 2 == 1)
        share = jnp.where(usable, square, jnp.sqrt(within) * jnp.sqrt(beyond))
        again = _Tried(share, kl_at(share), within, beyond, tried.tries + 1)
        more = unfinished(tried)
        return jax.tree.map(lambda new, old: jnp.where(more, new, old), again, tried)

    least, whole = jnp.full_like(first, _LEAST_SHARE), jnp.ones_like(first)
    begun = _Tried(first, kl_at(first), least, whole, jnp.int32(1))
    tried = while_any(unfinished, body, begun)
    last = jnp.where(tried.within > least, tried.within, jnp.nan)
    return jnp.where(fits(tried), tried.share, last)


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
