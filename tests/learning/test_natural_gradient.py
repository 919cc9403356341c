"""The natural gradient against a Fisher matrix made of score outer products, and its length."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from toys import Drift

from mjx_reinforce import mlp_policy, natural_gradient, reinforce, train_step
from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.learning import natural_gradient as module
from mjx_reinforce.learning import schedules
from mjx_reinforce.learning.bounded import tanh_normal, truncated_normal
from mjx_reinforce.learning.distributions import categorical, normal
from mjx_reinforce.learning.updates import Clock, Problem, full_batch
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.setup.build import _build_optimizer

MASK = np.arange(6)[:, None] < np.array([6, 1, 0, 4])
BOX = Box(np.array([-1.0, 0.0]), np.array([1.0, 4.0]))
FAMILIES = {
    "linear normal": (normal(BOX), ()),
    "normal": (normal(BOX), (3,)),
    "linear softplus": (normal(BOX, std="softplus"), ()),
    "categorical": (categorical(Discrete(3)), (3,)),
}
DAMPING, MAX_KL = 1e-2, 1e-3

#: Before the first update.
START = Clock(jnp.zeros(()), jnp.zeros(()))


def make(name, seed=0):
    """A policy with weights far from the first ones, and what a rollout of it leaves."""
    distribution, hidden_sizes = FAMILIES[name]
    policy = mlp_policy(3, distribution, hidden_sizes)
    keys = jax.random.split(jax.random.key(seed), 6)
    flat, unravel = ravel_pytree(policy.init(keys[0]))
    params = jax.tree.map(
        lambda x: x.astype(float), unravel(0.5 * jax.random.normal(keys[1], flat.shape, flat.dtype))
    )
    observation = jax.random.normal(keys[2], (*MASK.shape, 3))
    noise = distribution.noise(keys[3], MASK.shape)
    action = distribution.sample(policy.apply(params, observation), noise)
    weight = jnp.where(MASK, jax.random.normal(keys[4], MASK.shape), 0.0)
    samples = (observation, action, weight, jnp.asarray(MASK))

    def surrogate(params, samples):
        observation, action, weight, mask = samples
        log_prob = distribution.log_prob(policy.apply(params, observation), action)
        return -jnp.sum(jnp.where(mask, log_prob * weight, 0.0)), {"entropy": jnp.zeros(())}

    return policy, params, Problem(surrogate, optax.sgd(1.0), samples, 4, START)


def actions_and_probabilities(distribution, outputs):
    """Of a Normal the nodes and weights of a quadrature that is exact for a score's square."""
    if not distribution.constants and distribution.std is None:
        return np.arange(3), jax.nn.softmax(outputs)
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    pairs = np.array(list(itertools.product(nodes, nodes)))
    share = np.array([a * b for a, b in itertools.product(weights, weights)]) / (2 * np.pi)
    return distribution.sample(outputs, jnp.asarray(pairs)), share


def dense_fisher(policy, params, observations):
    """The mean over observations of E[score score^T], [P, P]."""
    flat, unravel = ravel_pytree(params)

    def of_one(observation):
        def log_prob(flat, action):
            return policy.distribution.log_prob(policy.apply(unravel(flat), observation), action)

        outputs = policy.apply(params, observation)
        actions, shares = actions_and_probabilities(policy.distribution, outputs)
        scores = jax.vmap(jax.grad(log_prob), (None, 0))(flat, jnp.asarray(actions))
        return (scores.T * jnp.asarray(shares)) @ scores

    return np.mean(jax.jit(jax.vmap(of_one))(observations), axis=0)


def stepper(update, params, problem):
    """Returns a compiled function from samples to the change of the parameters, and metrics."""

    @jax.jit
    def step(samples, key=None):
        key, start = jax.random.key(7) if key is None else key, problem.optimizer.init(params)
        after, _, metrics = update(problem._replace(samples=samples), key, params, start)
        return ravel_pytree(after)[0] - ravel_pytree(params)[0], metrics

    return step


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_the_step_is_that_of_a_dense_fisher_matrix(name):
    with jax.enable_x64(True):
        policy, params, problem = make(name)
        update = natural_gradient(policy, MAX_KL, damping=DAMPING, iterations=60)
        got, metrics = stepper(update, params, problem)(problem.samples)
        got = np.asarray(got)
        fisher = dense_fisher(policy, params, np.asarray(problem.samples[0])[MASK])
        plain, plain_metrics = stepper(full_batch(), params, problem)(problem.samples)
        plain = np.asarray(plain)
        direction = np.linalg.solve(fisher + DAMPING * np.eye(len(fisher)), plain)
        expected = np.sqrt(2 * MAX_KL / (plain @ direction)) * direction
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)
        model = 0.5 * got @ (fisher + DAMPING * np.eye(len(fisher))) @ got
        assert model == pytest.approx(MAX_KL, rel=1e-6)
        assert metrics.keys() == plain_metrics.keys()
        assert metrics["gradient_norm"] == pytest.approx(plain_metrics["gradient_norm"])


@pytest.mark.slow
def test_single_precision_and_observations_that_never_change():
    """One entry is 0 and one repeats another: the Fisher matrix is singular."""
    policy, params, problem = make("normal")
    observation, *others = problem.samples
    observation = observation.at[..., 1].set(0.0).at[..., 2].set(observation[..., 0])
    problem = problem._replace(samples=(observation, *others))
    update = natural_gradient(policy, MAX_KL, damping=1e-3, iterations=30)
    got, _ = stepper(update, params, problem)(problem.samples)
    assert got.dtype == np.float32
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), params)
        samples = tuple(
            jnp.asarray(np.asarray(x), bool if x.dtype == bool else float) for x in problem.samples
        )
        expected, _ = stepper(update, wide, problem)(samples)
        expected = np.asarray(expected)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-3 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear normal", "categorical"])
def test_the_scale_of_the_weights_does_not_matter_and_no_gradient_is_no_step(name):
    policy, params, problem = make(name)
    step = stepper(natural_gradient(policy, MAX_KL), params, problem)
    expected, _ = step(problem.samples)
    observation, action, weight, mask = problem.samples
    for scale in (2.0**-50, 2.0**20):  # of which float32 rounds none
        got, _ = step((observation, action, scale * weight, mask))
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-6)
    assert np.all(step((observation, action, 0 * weight, mask))[0] == 0.0)


@pytest.mark.slow
def test_steps_are_drawn_where_there_are_many(monkeypatch):
    """From inside the mask; the direction is about that of all."""
    policy, params, problem = make("normal")
    observation, *_ = problem.samples
    poisoned = jnp.where(MASK[..., None], observation, jnp.nan)
    update = natural_gradient(policy, MAX_KL, damping=0.1)
    every = np.asarray(stepper(update, params, problem)(problem.samples)[0])
    monkeypatch.setattr(module, "MAX_FISHER_STEPS", 20)
    keys = jax.random.split(jax.random.key(0), 20)
    step = stepper(update, params, problem)
    drawn = np.asarray(jax.vmap(lambda key: step(problem.samples, key)[0])(keys))
    cosines = drawn @ every / np.linalg.norm(drawn, axis=1) / np.linalg.norm(every)
    assert len(np.unique(cosines)) == len(drawn)
    assert cosines.mean() > 0.8
    found = jax.vmap(lambda key: module.draw_steps(key, jnp.asarray(MASK), (20,)))(keys)
    assert np.all(np.isfinite(poisoned.reshape(-1, 3)[found]))


@pytest.mark.slow
def test_a_step_moves_the_policy_by_about_the_divergence():
    """Of seeds side by side, as of one alone; a factor on the step counts by its square."""
    policy = mlp_policy(1, normal(Drift.action_space), (8,))
    update = natural_gradient(policy, 1e-3, damping=1e-3, iterations=20)

    def learn(key, rate, shrinking=1.0):
        optimizer = optax.chain(optax.sgd(rate), schedules.shrink_std(shrinking))
        learner = reinforce(
            Drift(),
            policy=policy,
            update=update,
            optimizer=optimizer,
            num_episodes=3,
            normalize_steps=0,
            engine="vmap",
        )
        state = dataclasses.replace(learner.init(key), progress=jnp.float32(0.1))
        after, metrics = learner.step(state)
        return ravel_pytree(after.actor.params)[0], metrics

    keys = jax.random.split(jax.random.key(3), 4)
    rates = jnp.repeat(jnp.array([1.0, 0.5, 0.0]), 4)
    shrinking = jnp.repeat(jnp.array([1.0, 1.0, 0.5]), 4)
    together, metrics = jax.jit(jax.vmap(learn))(jnp.tile(keys, 3), rates, shrinking)
    assert np.all(metrics["skipped_update"] == 0)
    np.testing.assert_allclose(metrics["kl"][:4], 1e-3, rtol=0.1)
    np.testing.assert_allclose(metrics["kl"][4:8], 2.5e-4, rtol=0.1)
    assert np.all(metrics["kl"][8:] > 1e-4)
    alone, _ = jax.jit(learn)(keys[2], 1.0)
    np.testing.assert_allclose(together[2], alone, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_settings_become_the_update():
    """The learning rate leaves a share of the step, relative to its first value."""
    natural = Config(update="natural-gradient", max_kl=0.01, decay_steps=None)
    for settings, last in (({}, 1.0), ({"learning_rate": 1e-3}, 1.0), ({"decay_steps": 8}, 0.1)):
        optimizer = _build_optimizer(dataclasses.replace(natural, **settings), Drift.action_space)
        state = optimizer.init(jnp.ones(2))
        for played, share in ((0.0, 1.0), (8.0, last)):
            clock = Clock(jnp.zeros(()), jnp.asarray(played))
            change, _ = optimizer.update(jnp.ones(2), state, jnp.ones(2), clock=clock)
            np.testing.assert_allclose(change, -share, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("family", [tanh_normal, truncated_normal])
def test_bounded_families_have_it_too(family):
    """What the damping adds to the model of the divergence, the policy moves less."""
    policy = mlp_policy(1, family(Drift.action_space), (4,))
    update = natural_gradient(policy, 1e-3)
    learner = reinforce(
        Drift(),
        policy=policy,
        update=update,
        optimizer=optax.sgd(1.0),
        num_episodes=3,
        normalize_steps=0,
        engine="vmap",
    )
    _, metrics = train_step(learner, jax.jit(learner.init)(jax.random.key(5)))
    assert metrics["skipped_update"] == 0
    assert 1e-4 < metrics["kl"] < 1.1e-3


def test_nonsense_is_refused():
    policy = mlp_policy(1, normal(Drift.action_space))
    unknown = mlp_policy(1, normal(Drift.action_space)._replace(kl=None))
    with pytest.raises(ValueError, match="KL divergence is known"):
        natural_gradient(unknown, 0.01)
    with pytest.raises(ValueError, match="max_kl must be positive"):
        natural_gradient(policy, 0.0)
    with pytest.raises(ValueError, match="damping must be positive"):
        natural_gradient(policy, 0.01, damping=0.0)
    with pytest.raises(ValueError, match="iterations must be at least 1"):
        natural_gradient(policy, 0.01, iterations=0)
    with pytest.raises(ValueError, match="policy must be of type Policy"):
        natural_gradient(normal(Drift.action_space), 0.01)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="length of its steps from --max-kl, which is None"):
        check(Config(update="natural-gradient"))
