"""Policies to play with, and what the episodes of two engines must have in common."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce import mlp_policy, normal
from mjx_reinforce.engine import base
from mjx_reinforce.engine.play import native, rollouts
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.policy import Actor


def actor_and_act(env, hidden_sizes, seed=0, distribution=None):
    size = base.observation_size(env)
    policy = mlp_policy(size, distribution or normal(base.action_space(env)), hidden_sizes)
    key = jax.random.key(seed)
    statistics = normalize.update(
        normalize.init(size), jax.random.normal(key, (5, 3, size)), jnp.ones((5, 3), bool), 100
    )
    actor = Actor(params=policy.init(key), normalizer=statistics)

    def act(actor, observation):
        return policy.apply(actor.params, normalize.apply(actor.normalizer, observation))

    return actor, act, policy.distribution


_COMPARED = ("observation", "action", "reward")


def assert_same_episodes(got, want, *, rounding):
    np.testing.assert_array_equal(got.mask, want.mask)
    np.testing.assert_array_equal(got.nonfinite, want.nonfinite)
    assert got.terms.keys() == want.terms.keys()
    compared = {name: (getattr(got, name), getattr(want, name)) for name in _COMPARED}
    compared |= {name: (got.terms[name], want.terms[name]) for name in got.terms}
    for name, pair in compared.items():
        np.testing.assert_allclose(*pair, atol=rounding, rtol=rounding, err_msg=name)


def played(play, env, player, num_seeds=3, num_episodes=5, **options):
    """Plays several seeds at once, each with its own key; the result on the host."""
    actor, act, distribution = player
    settings = {"num_episodes": num_episodes, "horizon": env.max_episode_steps} | options

    @jax.jit
    def all_seeds(keys, actor):
        def one(key, scale):
            scaled = jax.tree.map(lambda x: x * scale, actor)
            return play(env, act, scaled, distribution, key, **settings)

        return jax.vmap(one)(keys, jnp.linspace(1.0, 0.5, num_seeds))

    keys = jax.random.split(jax.random.key(4), num_seeds)
    return jax.tree.map(np.asarray, all_seeds(keys, actor))


def both(env, player, other=rollouts.vmap_rollout, **options):
    got = played(native.native_rollout, env, player, **options)
    return got, played(other, env, player, **options)


def only_active(play, env, player, chosen, **options):
    """Plays chosen episodes [S, N] of several seeds: zeros stand for all others. The result."""
    actor, act, distribution = player
    options["num_episodes"] = chosen.shape[1]

    def one(key, active):
        return play(env, act, actor, distribution, key, active=active, **options)

    keys, each = jax.random.split(jax.random.key(0), len(chosen)), jax.jit(jax.vmap(one))
    some, every = (jax.tree.map(np.asarray, each(keys, x)) for x in (chosen, chosen | True))
    assert every.mask[:, 0].all()
    np.testing.assert_array_equal(some.mask, every.mask & chosen[:, None])
    for name in ("observation", "action", "reward"):
        shown = some.mask.reshape(some.mask.shape + (1,) * (getattr(some, name).ndim - 3))
        np.testing.assert_array_equal(getattr(some, name), shown * getattr(every, name))
    assert not some.nonfinite.any()
    return some
