"""A trust region: a change of the policy is shortened to what a limit of KL allows.

This changes what is learned, unlike ``diagnostics``, from which it has the visited steps and the
divergence. The paper (Schulman et al. 2015, arXiv:1502.05477) solves for the step of greatest gain
within the region; here an update of any kind is shortened afterwards.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.episode import while_any
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.diagnostics import Visited, kl_divergence
from mjx_reinforce.learning.policy import Actor, Policy, act

#: A change that is shortened has at least so much of the limit of KL ...
_MIN_FILL = 0.5
#: ... and at most so much.
_MAX_FILL = 1.01
#: A share that is tried after the first is aimed at so much of the limit.
_TARGET_FILL = 0.95
#: The search for the share of a change ends at this share ...
_MIN_SHARE = 1e-30
#: ... or after so many shares.
_MAX_TRIALS = 40


def within_kl(
    policy: Policy,
    old_actor: Actor,
    new_actor: Actor,
    visited: Visited,
    max_kl: float | jax.Array | None,
) -> Actor:
    """Returns the actor on the straight way from ``old_actor`` to ``new_actor`` that KL allows.

    A change whose KL(old || new), the mean over visited steps, is greater than ``max_kl`` is
    shortened as a whole, the parameters and the scale of the observations alike. KL grows as the
    square of a small change, so the first share that is tried is sqrt(max_kl / KL) (as in the
    natural gradient's step, Schulman et al. 2015, arXiv:1502.05477, appendix C). Where that goes
    too far, or far less than it may, shares are tried between those that are known to be too small
    and too large, in the logarithm of the share. Its direction stays.

    The first scale of the observations is not learned: it comes whole, and the limit is that of
    the other changes. A share of it would remain where ``normalize_steps`` are fewer than the first
    update's: no later update would bring the rest.

    Args:
      policy: whose actor changes.
      old_actor: the actor that played.
      new_actor: the one that is proposed.
      visited: where the two are compared.
      max_kl: in nats; None limits nothing.

    Returns:
      An actor within the limit, to a hundredth of it. Where no share of the change is, its
      parameters are NaN, for ``keep_finite`` to see.
    """
    if max_kl is None:
        return new_actor
    is_unscaled = old_actor.normalizer.count == 0
    first_normalizer = jax.tree.map(
        lambda old, new: jnp.where(is_unscaled, new, old),
        old_actor.normalizer,
        new_actor.normalizer,
    )
    old_actor = old_actor.replace(normalizer=first_normalizer)
    old = act(policy, old_actor, visited.observation)

    def actor_at(share: jax.Array) -> Actor:
        """Returns the actor after a share [] of the change: 0 ``old_actor``, 1 ``new_actor``."""

        def blend(old_leaf: jax.Array, new_leaf: jax.Array) -> jax.Array:
            return old_leaf + share * (new_leaf - old_leaf)

        return Actor(
            params=jax.tree.map(blend, old_actor.params, new_actor.params),
            normalizer=normalize.between(old_actor.normalizer, new_actor.normalizer, share),
        )

    def kl_of(actor: Actor) -> jax.Array:
        new_outputs = act(policy, actor, visited.observation)
        kl = visited.mean(kl_divergence(policy.distribution, old, new_outputs, visited.action))
        return jnp.where(jnp.isfinite(kl), kl, jnp.inf)  # what overflows is beyond any limit

    # KL is near a square of the share, so this would fit where the change is small. An infinite KL
    # says nothing: then the search starts in the middle of its range, in the logarithm.
    full_kl = kl_of(new_actor)
    share = jnp.sqrt(max_kl / full_kl)
    share = jnp.where(share > _MIN_SHARE, share, _MIN_SHARE**0.5)
    first_share = jnp.where(full_kl <= max_kl, 1.0, share)
    share = _share_within(lambda share: kl_of(actor_at(share)), first_share, max_kl)
    return actor_at(share)


class _Search(NamedTuple):
    """Where the search for a share of a change is; all [].

    share: the last that was tried
    kl: that of the policies before the change and after this share of it
    low: the greatest share that is known to be within the limit
    high: the least that is known to be beyond it
    trials: how many were tried
    """

    share: jax.Array
    kl: jax.Array
    low: jax.Array
    high: jax.Array
    trials: jax.Array


def _share_within(
    kl_at: Callable[[jax.Array], jax.Array], first_share: jax.Array, max_kl: float | jax.Array
) -> jax.Array:
    """Returns a share [] of a change whose KL is within the limit, or NaN if none was found.

    Args:
      kl_at: share -> KL, infinite where it overflows.
      first_share: the share that is tried first. 1 is taken as it is.
      max_kl: in nats.
    """

    def fits(search: _Search) -> jax.Array:
        is_filled = (search.kl >= _MIN_FILL * max_kl) & (search.kl <= _MAX_FILL * max_kl)
        return is_filled | (search.share == 1.0)

    def unfinished(search: _Search) -> jax.Array:
        return ~fits(search) & (search.trials < _MAX_TRIALS)

    def body(search: _Search) -> _Search:
        """Tries a share between the greatest that fits and the least that does not."""
        is_below = search.kl <= _MAX_FILL * max_kl
        low = jnp.where(is_below, search.share, search.low)
        high = jnp.where(is_below, search.high, search.share)
        # If KL were a square of the share, this share would hit the target. Where it is no square,
        # every second share halves what is left between low and high, in the logarithm.
        root_share = search.share * jnp.sqrt(_TARGET_FILL * max_kl / search.kl)
        is_usable = (root_share > low) & (root_share < high) & (search.trials % 2 == 1)
        share = jnp.where(is_usable, root_share, jnp.sqrt(low) * jnp.sqrt(high))
        next_search = _Search(share, kl_at(share), low, high, search.trials + 1)
        # Vmapped over seeds, the loop goes on until the last one is done; the others stay.
        is_open = unfinished(search)
        return jax.tree.map(lambda new, old: jnp.where(is_open, new, old), next_search, search)

    min_share = jnp.full_like(first_share, _MIN_SHARE)
    max_share = jnp.ones_like(first_share)
    start = _Search(first_share, kl_at(first_share), min_share, max_share, jnp.int32(1))
    search = while_any(unfinished, body, start)
    # Out of trials: the greatest share that fitted will do. ``low`` as it began is none.
    fallback = jnp.where(search.low > min_share, search.low, jnp.nan)
    return jnp.where(fits(search), search.share, fallback)
