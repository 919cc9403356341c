"""Diagnostics against closed forms, enumerated episodes, and updates made to be so."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from problems import PARAMS, make_problem
from scipy import stats
from toys import Survive, Target, categorical

from mjx_reinforce import Trajectory, mlp_policy, normal, reinforce
from mjx_reinforce.learning import diagnostics, normalize, trust_region, updates
from mjx_reinforce.learning.policy import Actor


def make_trajectory(lengths, horizon, poison=0.0):
    """The observation is the number of the step; behind the end stands ``poison``."""
    mask = np.arange(horizon)[:, None] < np.array(lengths)
    number = np.broadcast_to(np.arange(horizon, dtype=float)[:, None], mask.shape)
    seen = jnp.asarray(np.where(mask, number, poison))[..., None]
    return Trajectory(
        observation=seen,
        action=0.1 * seen,
        reward=jnp.asarray(mask, float),
        mask=jnp.asarray(mask),
        nonfinite=jnp.zeros(len(lengths), bool),
        simulated=jnp.int32(mask.size),
    )


def test_of_few_steps_all_are_visited():
    visited = diagnostics.visited_steps(make_trajectory([5, 1, 3], 7))
    weight, seen = np.asarray(visited.weight), np.asarray(visited.observation[..., 0])
    for n, length in enumerate([5, 1, 3]):
        assert sorted(seen[weight[:, n] > 0, n]) == list(range(length))
    np.testing.assert_allclose(weight[weight > 0], 1 / 9, rtol=1e-6)
    assert float(visited.mean(visited.observation[..., 0])) == pytest.approx(13 / 9, rel=1e-6)


def test_of_many_steps_each_stands_for_its_neighbors(monkeypatch):
    """Three of each episode: of 10 steps every fourth, of 2 both; each counts as its share."""
    monkeypatch.setattr(diagnostics, "MAX_COMPARED", 6)
    visited = diagnostics.visited_steps(make_trajectory([10, 2], 10))
    weight, seen = np.asarray(visited.weight), np.asarray(visited.observation[..., 0])
    assert seen[weight[:, 0] > 0, 0].tolist() == [2, 6]
    assert seen[weight[:, 1] > 0, 1].tolist() == [0, 1]
    np.testing.assert_allclose(weight.sum(axis=0), [10 / 12, 2 / 12], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("num_episodes", [1, 40, 64, 65, 1000])
def test_no_more_steps_than_promised_are_visited(num_episodes):
    visited = diagnostics.visited_steps(make_trajectory([300] * num_episodes, 300, np.nan))
    assert 32 <= visited.weight.size <= diagnostics.MAX_COMPARED
    assert float(jnp.sum(visited.weight)) == pytest.approx(1, rel=1e-5)
    assert np.all(np.isfinite(visited.observation))


@pytest.mark.slow
def test_nothing_after_the_end_is_visited():
    policy = mlp_policy(1, normal(Target.action_space), ())
    actor = Actor(params=policy.init(jax.random.key(0)), normalizer=normalize.init(1))
    moved = actor.replace(params=jax.tree.map(lambda x: x + 0.1, actor.params))
    clean, poisoned = (
        diagnostics.policy_metrics(
            policy, actor, moved, diagnostics.visited_steps(make_trajectory([4, 9], 20, poison))
        )
        for poison in (0.0, np.nan)
    )
    assert clean == poisoned
    assert clean["policy_std"] == pytest.approx(0.5, rel=1e-6)
    assert clean["kl"] > 0


def test_the_estimated_kl_is_unbiased_and_never_negative():
    """Its mean over all actions, weighted by the old policy, is the divergence."""
    family, actions = categorical(3), jnp.arange(3)
    old, new = jnp.array([0.3, -1.0, 2.0]), jnp.array([0.0, 0.5, 1.0])
    each = diagnostics.kl_divergence(family, *(jnp.tile(x, (3, 1)) for x in (old, new)), actions)
    p, q = jax.nn.softmax(old), jax.nn.softmax(new)
    assert float(p @ each) == pytest.approx(stats.entropy(p, q), rel=1e-5)
    assert np.all(np.asarray(each) > 0)


def test_the_noise_of_all_episodes_is_the_sample_variance_of_their_mean():
    each = np.random.default_rng(0).normal(size=(6, 3)) + 1
    mean = each.mean(axis=0)
    got = updates.signal_to_noise(jnp.asarray(mean), jnp.asarray(each), 6)
    noise = np.sum(np.var(each, axis=0, ddof=1)) / 6
    assert float(got) == pytest.approx((np.sum(mean**2) - noise) / noise, rel=1e-4)


@pytest.mark.slow
def test_the_noise_is_that_of_some_episodes_beside_the_mean_of_all():
    """Of 65 episodes that of two; see ``updates.signal_to_noise``."""
    mask = np.arange(5)[:, None] < np.random.default_rng(1).integers(1, 6, 65)
    problem = make_problem(optax.sgd(0.1), mask=mask)
    _, _, metrics = updates.full_batch()(problem, None, PARAMS, problem.optimizer.init(PARAMS))

    def gradient(part):
        samples = tuple(x[:, part] for x in problem.samples)
        grads = jax.grad(lambda p: problem.surrogate(p, samples)[0])(PARAMS)
        return np.array(jax.tree.leaves(grads))

    mean = gradient(slice(None)) / 65
    apart = [np.sum((gradient(slice(n, n + 1)) - mean) ** 2) for n in (0, 1)]
    expected = np.sum(mean**2) / (np.mean(apart) / 64) - 1
    assert float(metrics["gradient_snr"]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_an_update_goes_no_further_than_it_may():
    """From the second update on: the first also scales the observations, which counts, too."""

    @jax.jit
    def moved(max_kl):
        learner = reinforce(Survive(), num_episodes=4, max_kl=max_kl)
        state = learner.init(jax.random.key(0))
        state = dataclasses.replace(state, actor=scaled(state.actor))
        after, metrics = learner.step(state)
        change = jax.tree.map(jnp.subtract, after.actor.params, state.actor.params)
        return ravel_pytree(change)[0], metrics["kl"]

    def scaled(actor):  # counted enough already
        counted = actor.normalizer.replace(count=jnp.float32(2000), m2=jnp.full(1, 2000.0))
        return actor.replace(normalizer=counted)

    free, free_kl = moved(jnp.inf)
    np.testing.assert_allclose(free, moved(None)[0], atol=1e-6)  # it rounds otherwise
    for share in (0.5, 0.1, 0.01):
        short, kl = moved(share * free_kl)
        assert kl == pytest.approx(share * float(free_kl), rel=0.1)
        cosine = free @ short / np.linalg.norm(free) / np.linalg.norm(short)
        assert cosine == pytest.approx(1, abs=1e-4)
    same, same_kl = moved(2 * free_kl)
    assert np.array_equal(same, free)
    assert same_kl == free_kl


@pytest.mark.slow
def test_a_change_without_a_kl_is_kept_as_it_is():
    policy = mlp_policy(1, normal(Survive.action_space), ())
    actor = Actor(params=policy.init(jax.random.key(0)), normalizer=normalize.init(1))
    visited = diagnostics.visited_steps(make_trajectory([4, 9], 20))
    same = trust_region.within_kl(policy, actor, actor, visited, 0.01)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), same, actor))
    broken = actor.replace(params=jax.tree.map(lambda x: x * jnp.nan, actor.params))
    kept = trust_region.within_kl(policy, actor, broken, visited, 0.01).params
    assert all(np.isnan(x).all() for x in jax.tree.leaves(kept))  # for ``keep_finite`` to see
