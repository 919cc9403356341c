"""The kernel of a small network's gradient, interpreted, against ``jax.value_and_grad``."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import envs, mlp_policy, reinforce, train_step
from mjx_reinforce.learners import gradient_kernel
from mjx_reinforce.learners.reinforce import _loss, _surrogate
from mjx_reinforce.registry import DISTRIBUTIONS, load_choice
from mjx_reinforce.types import Box, Discrete

SAMPLES = 9 * 11
OPTIONS = {"interpret": True, "tile": 32, "programs": 2, "multiply": "ieee"}


def problem(family, hidden=(16, 32), seed=0):
    """Returns a policy, its parameters and 9 x 11 samples, no multiple of a tile."""
    box = Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 3.0], np.float32))
    space = Discrete(3) if family == "categorical" else box
    policy = mlp_policy(5, load_choice("policy", family, DISTRIBUTIONS)(space), hidden)
    keys = jax.random.split(jax.random.key(seed), 6)
    params = jax.tree.map(
        lambda x: x + 0.2 * jax.random.normal(keys[0], x.shape), policy.init(keys[1])
    )
    observation = 2.0 * jax.random.normal(keys[2], (9, 11, 5))
    outputs = policy.apply(params, observation)
    noise = policy.distribution.noise(keys[3], (9, 11))
    action = policy.distribution.sample(outputs, noise)
    weight = jax.random.normal(keys[4], (9, 11))
    mask = jax.random.uniform(keys[5], (9, 11)) < 0.7
    return policy, params, (observation, action, weight, mask)


def by_kernel(policy, cost, params, samples):
    loss = _loss(policy.distribution, cost)
    return gradient_kernel.gradient(policy, loss, params, samples, **OPTIONS)


def by_xla(policy, cost, params, samples):
    differentiate = jax.value_and_grad(_surrogate(policy, cost), has_aux=True)
    (value, metrics), grads = differentiate(params, samples)
    return value, grads, metrics


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert x.shape == y.shape
        # The loss is a sum of terms of both signs, of about 1 each.
        assert np.linalg.norm(x - y) <= 1e-5 * (np.linalg.norm(y) if y.ndim else SAMPLES)


@pytest.mark.parametrize("family", [x for x in DISTRIBUTIONS if x != "deterministic"])
def test_every_distribution(family):
    policy, params, samples = problem(family)
    found = jax.jit(functools.partial(by_kernel, policy))(0.3, params, samples)
    assert_equal(found, jax.jit(functools.partial(by_xla, policy))(0.3, params, samples))


@pytest.mark.parametrize("hidden", [(24,), (64, 64), (16, 8, 20)])
def test_layers(hidden):
    policy, params, samples = problem("normal", hidden)
    assert_equal(by_kernel(policy, 0.0, params, samples), by_xla(policy, 0.0, params, samples))


def test_seeds_of_their_own():
    """Parameters, samples and the cost of entropy differ; one more axis shares the samples."""
    made = [problem("normal", seed=k) for k in range(4)]
    policy = made[0][0]
    params, samples = jax.tree.map(lambda *x: jnp.stack(x), *(x[1:] for x in made))
    params = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), params)
    samples = jax.tree.map(lambda x: x[:2], samples)
    costs = jnp.array([0.1, 0.4])
    found, expected = (
        jax.jit(jax.vmap(jax.vmap(functools.partial(f, policy), (None, 0, None)), (0, 0, 0)))(
            costs, params, samples
        )
        for f in (by_kernel, by_xla)
    )
    assert_equal(found, expected)


def test_what_is_not_finite_shows():
    policy, params, (observation, action, weight, mask) = problem("normal")
    weight = weight.at[3, 4].set(jnp.nan)
    alive, dead = (mask.at[3, 4].set(x) for x in (True, False))
    _, grads, _ = by_kernel(policy, 0.0, params, (observation, action, weight, alive))
    assert np.isnan(grads["network"]["params"]["Dense_0"]["kernel"]).any()
    nothing = jnp.zeros_like(mask)
    value, grads, _ = by_kernel(policy, 0.0, params, (observation, action, weight, nothing))
    assert value == 0
    assert not any(x.any() for x in jax.tree.leaves(grads))
    samples = observation, action, jnp.where(dead, weight, 0.0), dead
    assert_equal(by_kernel(policy, 0.0, params, samples), by_xla(policy, 0.0, params, samples))


@pytest.mark.parametrize("loss_per", ["episode", "step"])
def test_a_learner_takes_it(loss_per, monkeypatch):
    env = envs.make("CartPole-v1")
    kernel = functools.partial(gradient_kernel.gradient, **OPTIONS)
    found = []
    for on in (False, True):
        if on:
            monkeypatch.setattr(gradient_kernel, "unsupported", gradient_kernel.unfit)
            monkeypatch.setattr(gradient_kernel, "gradient", kernel)
        learner = reinforce(env, num_episodes=4, horizon=20, loss_per=loss_per, entropy_cost=0.1)
        state, metrics = train_step(learner, learner.init(jax.random.key(0)))
        found.append((state.actor.params, metrics["gradient_norm"]))
    assert_equal(found[1], found[0])
    assert any(
        (x != y).any()
        for x, y in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True)
    ), "the kernel rounds otherwise; it was not taken"


def test_for_which_policies():
    policy, *_ = problem("normal")
    assert gradient_kernel.unfit(policy, 5) is None
    assert gradient_kernel.unsupported(policy, 5) is not None, "there is no GPU here"
    other = policy._replace(apply=lambda *given: policy.apply(*given))
    assert gradient_kernel.unfit(other, 5) is not None
    assert gradient_kernel.unfit(problem("normal", (128,))[0], 5) is not None
    assert gradient_kernel.unfit(problem("normal", ())[0], 5) is not None
    assert gradient_kernel.unfit(policy, 200) is not None
    with jax.enable_x64(True):
        assert gradient_kernel.unfit(policy, 5) is not None
