"""What an update may do at most, whatever the family, the step, and the numbers of the task."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import integrate, special, stats
from toys import Chain, Drift, Signed, SignedTarget

import mjx_reinforce as mr
from mjx_reinforce import Box, mlp_policy, reinforce
from mjx_reinforce.learning import bounded, normalize
from mjx_reinforce.learning import estimators as est
from mjx_reinforce.registry import DISTRIBUTIONS, load_definition

FAMILIES = sorted({*DISTRIBUTIONS} - {"deterministic"})
LIMIT = 0.01
#: A step as usual, and such as saturate a softmax, or shrink a standard deviation to nothing.
RATES = (0.3, 10.0, 1e3, 1e5, 1e8, 1e20)


class Far(Drift):
    """``Drift`` seen in another unit, and away from 0."""

    def __init__(self, unit):
        self.unit = unit

    def reset(self, rng):
        return self.seen(super().reset(rng))

    def step(self, state, action):
        inside = state.replace(obs=(state.obs - 1.0) / self.unit)
        return self.seen(super().step(inside, action))

    def seen(self, state):
        return state.replace(obs=1.0 + self.unit * state.obs)


def exact_kl(family, policy, before, after, observation):
    """Returns the divergence [...] at observations [..., O], of ``normal`` by the textbook."""
    old, new = (np.asarray(mr.act(policy, x, observation), float) for x in (before, after))
    if family == "normal":
        (m, p), (n, q) = ((x[..., 0], np.exp(x[..., 1])) for x in (old, new))
        return np.log(q / p) + (p**2 + (m - n) ** 2) / (2 * q**2) - 0.5
    if family == "categorical":
        log_old, log_new = (special.log_softmax(x, axis=-1) for x in (old, new))
        return np.sum(np.exp(log_old) * (log_old - log_new), -1)
    return np.asarray(policy.distribution.kl(jnp.asarray(old), jnp.asarray(new)))


def visited_mean(values, mask):
    return float(np.sum(np.where(mask, values, 0)) / np.sum(mask))


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_an_update_of_any_size_moves_the_policy_up_to_the_limit(family):
    """Not beyond it, and not by nothing: all visited steps are compared, as they are few."""
    env = Chain() if family == "categorical" else Drift()
    size = 3 if family == "categorical" else 1
    make = load_definition(DISTRIBUTIONS[family])
    policy = mlp_policy(size, make(env.action_space), (4,))

    @jax.jit
    def update(rate, key):
        learner = reinforce(
            env,
            policy=policy,
            estimator=est.leave_one_out(1.0),
            optimizer=optax.sgd(rate),
            num_episodes=3,
            max_kl=LIMIT,
            normalize_steps=0,
            engine="vmap",
        )
        state = learner.init(key)
        played = learner.play(state, jax.random.split(key, 3)[1])
        after, metrics = learner.learn(state, played, key)
        return state.actor, after.actor, played, metrics

    for rate in RATES:
        before, after, played, metrics = update(rate, jax.random.key(5))
        each = exact_kl(family, policy, before, after, played.observation)
        kl = visited_mean(each, played.mask)
        assert metrics["skipped_update"] == 0
        assert kl <= 1.02 * LIMIT
        assert kl >= 0.4 * LIMIT or rate == RATES[0]
        assert float(metrics["kl"]) == pytest.approx(kl, rel=0.02, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [5.0, 30.0])
def test_the_limit_counts_the_new_scale_of_the_observations(unit):
    """Of weights that are not small, a scale alone moves the policy much further.

    The first one does, and is not counted: it comes whole. In the second unit it also clips what
    the policy saw.
    """
    env, policy = Far(unit), mlp_policy(1, mr.normal(Drift.action_space), (8,), initializer="torch")
    learner = reinforce(
        env,
        policy=policy,
        num_episodes=3,
        max_kl=LIMIT,
        normalize_steps=np.inf,
        optimizer=optax.adam(0.05),
        engine="vmap",
    )
    state, seen = jax.jit(learner.init)(jax.random.key(1)), []
    for number in range(30):
        played = jax.jit(learner.play)(state, jax.random.split(state.key, 3)[1])
        after, metrics = mr.train_step(learner, state)
        each = exact_kl("normal", policy, state.actor, after.actor, played.observation)
        kl = visited_mean(each, played.mask)
        if metrics["nonfinite_episodes"] == 0:
            assert float(metrics["kl"]) == pytest.approx(kl, rel=0.02, abs=1e-6)
        assert kl <= 1.02 * LIMIT or number == 0
        assert metrics["skipped_update"] == 0
        state = after
        seen.append(np.asarray(played.observation)[np.asarray(played.mask)])
    scale = float(normalize.standard_deviation(state.actor.normalizer)[0])
    assert scale == pytest.approx(np.std(np.concatenate(seen)), rel=0.3)  # held back, it arrives


def test_the_first_scale_comes_whole_where_the_update_is_shortened():
    """One update has more than --normalize-steps observations, and so no later one is counted."""
    learner = reinforce(
        Far(5.0),
        policy=mlp_policy(1, mr.normal(Drift.action_space), (4,)),
        num_episodes=3,
        max_kl=LIMIT,
        normalize_steps=1,
        optimizer=optax.sgd(1e3),
        engine="vmap",
    )

    @jax.jit
    def update(state):
        played = learner.play(state, jax.random.key(2))
        return played, *learner.learn(state, played, jax.random.key(3))

    state = jax.jit(learner.init)(jax.random.key(1))
    played, after, metrics = update(state)
    assert metrics["skipped_update"] == 0
    seen = np.asarray(played.observation)[np.asarray(played.mask & ~played.nonfinite)]
    assert after.actor.normalizer.count == len(seen)
    np.testing.assert_allclose(after.actor.normalizer.mean, seen.mean(0), rtol=1e-5)
    scale = normalize.standard_deviation(after.actor.normalizer)
    np.testing.assert_allclose(scale, seen.std(0), rtol=1e-5)
    # The limit is that of the parameters, both seen in the new scale.
    unlearned = state.actor.replace(normalizer=after.actor.normalizer)
    each = exact_kl("normal", learner.policy, unlearned, after.actor, played.observation)
    assert 0.4 * LIMIT <= visited_mean(each, played.mask) <= 1.02 * LIMIT


def test_a_share_of_the_scale_lies_between():
    old, new = (
        normalize.Normalizer(count=jnp.float32(n), mean=jnp.array([m]), m2=jnp.array([s]))
        for n, m, s in ((100, 4.0, 900.0), (300, 2.0, 500.0))
    )
    for share, expected in ((0.0, (100, 4.0, 900.0)), (0.25, (150, 3.5, 800.0))):
        part = normalize.between(old, new, jnp.float32(share))
        assert (part.count, part.mean[0], part.m2[0]) == expected
    for share in (0.5, 1.0):
        same = normalize.between(new, new, jnp.float32(share))
        assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), same, new))
    assert normalize.between(old, new, jnp.float32(1.0)).mean == new.mean


@pytest.mark.slow
@pytest.mark.parametrize("std", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("mean", [0.3, -2.0, 9.0])
def test_the_divergence_of_truncated_normals_is_the_integral(mean, std):
    """The referee is SciPy's density; the range is [-1, 1]."""
    changes = [(0.0, 0.9 * std), (0.02, 1.01 * std), (-1.0, 2.0 * std)]
    for shift, other in changes:
        p, q = (
            stats.truncnorm((-1 - m) / s, (1 - m) / s, loc=m, scale=s)
            for m, s in ((mean, std), (mean + shift, other))
        )
        points = [p.mean() - p.std(), p.mean(), p.mean() + p.std()]

        def weighed(x, p=p, q=q):
            log_density = p.logpdf(x)
            density = np.exp(log_density)
            return density * (log_density - q.logpdf(x)) if density > 0 else 0.0

        expected, _ = integrate.quad(
            weighed,
            -1,
            1,
            points=[x for x in points if -1 < x < 1],
            limit=500,
        )
        numbers = (jnp.float32(x) for x in (mean, std, mean + shift, other, -1.0, 1.0))
        got = float(bounded.truncated_kl(*numbers))
        assert got == pytest.approx(expected, rel=2e-3, abs=3e-6)


@pytest.mark.parametrize("mean", [4.0, 4.5, 4.9])
@pytest.mark.parametrize("std", [1e-4, 1e-3, 1e-2])
def test_the_score_of_a_tanh_is_zero_at_small_deviations(mean, std):
    family = mr.tanh_normal(Box(-np.ones(1), np.ones(1)))
    outputs = jnp.array([mean, np.log(std)])
    noise = family.noise(jax.random.key(0), (200_000,))
    actions = jax.jit(family.sample)(jnp.broadcast_to(outputs, (200_000, 2)), noise)
    score = jax.jit(jax.vmap(jax.grad(family.log_prob), (None, 0)))(outputs, actions)
    error = np.std(score, axis=0) / np.sqrt(len(score))
    assert np.all(np.abs(np.mean(score, axis=0)) <= 5 * error + 1e-2)
    assert float(family.std(outputs)[0]) == pytest.approx(max(std, 5e-3))


def test_a_tanh_without_noise_is_refused():
    with pytest.raises(ValueError, match=r"initial_std of 0.005 of half .* \[1.0, 0.01\]"):
        mr.tanh_normal(Box(np.array([-200.0, -2]), np.array([200.0, 2])), initial_std=0.5)


def constant(trajectory_reward, num_episodes=4):
    """Returns a trajectory of five steps that all earn the same."""
    ones = jnp.ones((5, num_episodes))
    return mr.Trajectory(
        observation=ones[..., None],
        action=ones[..., None],
        reward=trajectory_reward * ones,
        mask=ones > 0,
        nonfinite=jnp.zeros(num_episodes, bool),
        simulated=jnp.int32(5 * num_episodes),
    )


@pytest.mark.parametrize("reward", [1.0, -3e4, 1e30])
def test_the_rounding_of_equal_returns_is_no_weight(reward):
    estimator = mr.standardize(mr.leave_one_out())
    weight, _, _ = jax.jit(estimator.update)((), constant(reward))
    np.testing.assert_array_equal(weight, 0)


class Paid(SignedTarget):
    """``SignedTarget`` whose rewards are multiplied."""

    def __init__(self, factor):
        self.factor = factor

    def earn(self, obs, action):
        return self.factor * super().earn(obs, action)


@functools.cache
def learned(factor, floor=0.0):
    estimator = est.leave_one_out(1.0)
    estimator = estimator if floor is None else mr.standardize(estimator, floor=floor)
    learner = reinforce(Paid(factor), estimator=estimator, engine="vmap", num_episodes=8)
    before = jax.jit(learner.init)(jax.random.key(0))
    after, metrics = mr.train_step(learner, before)
    return jax.tree.map(jnp.subtract, after.actor.params, before.actor.params), metrics


@pytest.mark.slow
def test_rewards_of_any_size_teach_the_same():
    expected, _ = learned(1.0)
    for factor in (1e20, 1e30):
        got, metrics = learned(factor)
        assert metrics["skipped_update"] == 0
        assert np.isfinite([metrics["explained_variance"], metrics["gradient_norm"]]).all()
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_a_gradient_that_overflows_is_a_skipped_update():
    """Without a division of the weights nothing can be learned from such rewards; it is counted."""
    change, metrics = learned(1e30, None)
    assert metrics["skipped_update"] == 1
    assert all(np.all(x == 0) for x in jax.tree.leaves(change))


class Rich(Signed):
    """Three steps; an episode that begins at 1 earns more than float32 holds."""

    max_episode_steps = 3

    def step(self, state, action):
        reward = jnp.where(state.obs[0] > 0, 2e38, 1.0)
        return state.replace(reward=reward)


@pytest.mark.slow
def test_a_return_that_overflows_is_a_broken_episode():
    learner = reinforce(Rich(), engine="vmap", num_episodes=8)
    state = jax.jit(learner.init)(jax.random.key(0))
    after, metrics = mr.train_step(learner, state)
    assert 0 < metrics["nonfinite_episodes"] < 8
    assert metrics["skipped_update"] == 0
    assert np.all(np.isfinite(np.concatenate([x.ravel() for x in jax.tree.leaves(after.actor)])))


class Huge(Drift):
    """The observation is 1e30, whatever happens."""

    def reset(self, rng):
        return super().reset(rng).replace(obs=jnp.full(1, 1e30))

    def step(self, state, action):
        return super().step(state.replace(obs=jnp.zeros(1)), action).replace(obs=state.obs)


def test_an_observation_that_overflows_is_scaled():
    learner = reinforce(Huge(), engine="vmap", num_episodes=4)
    state = jax.jit(learner.init)(jax.random.key(0))
    for _ in range(3):
        state, metrics = mr.train_step(learner, state)
        assert metrics["skipped_update"] == 0
    assert np.all(np.isfinite(normalize.standard_deviation(state.actor.normalizer)))
    assert abs(float(state.actor.normalizer.mean[0])) == pytest.approx(1e15)
