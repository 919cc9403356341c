"""Augmented random search: one update by hand, no update without a difference, toys solved."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from toys import SignedTarget, Survive, Target, Tempting

from mjx_reinforce import deterministic, evaluate, mlp_policy, rollout, train_step
from mjx_reinforce.engine import counts
from mjx_reinforce.published.ars import ars
from mjx_reinforce.published.continuous_cartpole import increment, random_search
from mjx_reinforce.settings.config import Config


def by_hand(directions, plus, minus):
    """The paper's step, over step_size, in NumPy."""
    return (plus - minus) @ directions / (len(plus) * np.std([*plus, *minus]))


@pytest.mark.slow
def test_one_update_by_hand():
    """Every perturbed policy is played by itself, from the start that its place gives it."""
    env = SignedTarget()
    policy = mlp_policy(1, deterministic(env.action_space), (3,))
    learner = ars(env, policy=policy, num_directions=5, step_size=0.3, noise_std=0.2)
    state = jax.jit(learner.init)(jax.random.key(0))
    state, _ = train_step(learner, state)  # Observations are normalized from here on.
    flat, unflatten = jax.flatten_util.ravel_pytree(state.actor.params)
    _, play_key, _ = jax.random.split(state.key, 3)
    _, episodes_key = jax.random.split(play_key)
    tried = learner.play(state, play_key, True)
    directions = jax.vmap(lambda d: jax.flatten_util.ravel_pytree(d)[0])(tried.directions)

    @jax.jit
    def play(sign, key, k):
        actor = state.actor.replace(params=unflatten(flat + sign * 0.2 * directions[k]))
        trajectory = rollout(
            env, learner.act, actor, policy.distribution, key, num_episodes=5, horizon=1
        )
        return trajectory.reward[0, k]

    keys = jax.random.split(episodes_key)
    plus, minus = (
        np.array([float(play(sign, key, k)) for k in range(5)])
        for sign, key in zip((1.0, -1.0), keys, strict=True)
    )
    after, metrics = train_step(learner, state)
    moved = jax.flatten_util.ravel_pytree(after.actor.params)[0] - flat
    expected = 0.3 * by_hand(np.asarray(directions), plus, minus)
    np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-6)
    assert float(metrics["episode_return"]) == pytest.approx(np.mean([plus, minus]), rel=1e-5)
    assert float(metrics["return_std"]) == pytest.approx(np.std([plus, minus]), rel=1e-5)
    assert int(metrics["env_steps"]) == 10
    assert int(after.actor.normalizer.count) == 20


def test_the_documents_update_by_hand():
    """One increment for all parameters; the bias is a copy of the first weight."""
    directions = {"kernel": jnp.array([[[1.0], [2.0]], [[0.5], [-1.0]]]), "bias": jnp.ones((2, 1))}
    returns = jnp.array([[5.0, 2.0], [3.0, 6.0]])
    step = increment(directions, returns, 0.1)
    expected = 0.1 * (2.0 * 4.0 - 4.0 * 0.5) / np.std([5.0, 2.0, 3.0, 6.0])
    for leaf in jax.tree.leaves(step):
        np.testing.assert_allclose(leaf, expected, rtol=1e-6)
    policy = mlp_policy(1, deterministic(Target.action_space), ())
    learner = random_search(Target(), Config(hidden_sizes=()), policy=policy)
    state, _ = train_step(learner, jax.jit(learner.init)(jax.random.key(0)))
    layer = state.actor.params["network"]["params"]["Dense_0"]
    assert float(layer["kernel"][0, 0]) == float(layer["bias"][0]) != 0.0


class Constant(Target):
    def earn(self, obs, action):
        return jnp.full((), 0.1)


class Hopeless(Tempting):
    def step(self, state, action):
        return super().step(state, jnp.ones(1))


@pytest.mark.slow
@pytest.mark.parametrize("increment", [None, increment])
@pytest.mark.parametrize(("env", "broken"), [(Constant(), 0), (Hopeless(), 16)])
def test_equal_returns_and_episodes_that_all_broke_teach_nothing(env, broken, increment):
    learner = ars(env, increment=increment, engine="vmap")
    state = jax.jit(learner.init)(jax.random.key(0))
    after, metrics = train_step(learner, state)
    jax.tree.map(np.testing.assert_array_equal, after.actor.params, state.actor.params)
    assert int(metrics["nonfinite_episodes"]) == broken
    assert float(after.actor.normalizer.count) == (0 if broken else 16)
    assert int(metrics["skipped_update"]) == 0
    assert counts.to_int(after.num_updates) == 1


def train(env, num_updates, **settings):
    learner = ars(env, **settings)
    state = jax.jit(learner.init)(jax.random.key(0))
    state, metrics = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: learner.step(s), s, length=num_updates)
    )(state)
    return learner, state, metrics


@pytest.mark.slow
def test_the_best_action_is_found():
    learner, state, _ = train(SignedTarget(), 200, step_size=0.05, noise_std=0.1)
    obs = jnp.array([[-1.0], [1.0]])
    mode = learner.policy.distribution.mode(learner.act(state.actor, obs))
    np.testing.assert_allclose(mode[:, 0], [-0.5, 0.5], atol=0.15)
    result = evaluate(
        SignedTarget(), learner, state.actor, jax.random.key(1), num_episodes=8, horizon=1
    )
    assert float(result["eval_return"]) > -0.03


@pytest.mark.slow
def test_seeds_together_and_standing_still():
    learner = ars(Survive(), num_directions=4, noise_std=0.5)
    keys = jax.random.split(jax.random.key(0), 3)
    states = jax.jit(jax.vmap(learner.init))(keys)
    together, metrics = jax.jit(jax.vmap(learner.step))(states, jnp.array([True, True, False]))
    alone, _ = train_step(learner, jax.jit(learner.init)(keys[1]))
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x[1], y, rtol=1e-4, atol=1e-6),
        together.actor,
        alone.actor,
    )
    jax.tree.map(
        lambda x, y: np.testing.assert_array_equal(x[2], y[2]), together.actor, states.actor
    )
    assert int(metrics["env_steps"][2]) == 0


@pytest.mark.slow
def test_hyperparameters_vmap_and_keys_are_used_once():
    def step(step_size):
        learner = ars(Target(), step_size=step_size)
        state = learner.init(jax.random.key(0))
        after, _ = learner.step(state)
        return jax.flatten_util.ravel_pytree(after.actor.params)[0]

    moves = jax.jit(jax.vmap(step))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(2 * moves[0], moves[1], rtol=1e-4)
    with jax.debug_key_reuse(True):
        learner = ars(Survive(), num_directions=4)
        state = jax.jit(learner.init)(jax.random.key(0))
        state, _ = train_step(learner, state)
        train_step(learner, state)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_directions": 0}, "num_directions must be at least 1"),
        ({"step_size": 0.0}, "step_size must be positive"),
        ({"noise_std": -1.0}, "noise_std must be positive"),
    ],
)
def test_nonsense_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ars(Target(), **settings)


def test_breaking_never_pays():
    """It ends an episode whose every step costs, and yet it is not searched for."""
    _, _, metrics = train(Tempting(), 60, noise_std=1.0, step_size=0.1, engine="vmap")
    broken = np.asarray(metrics["nonfinite_episodes"])
    assert broken[:5].mean() > 2
    assert broken[-5:].mean() < broken[:5].mean()
