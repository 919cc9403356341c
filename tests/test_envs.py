"""The contract of every registered environment, and its life under brax's own tools."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.envs import wrappers

from mjx_reinforce import Environment, envs
from mjx_reinforce.types import action_space, observation_size

IDS = envs.names()


@pytest.fixture(scope="module", params=IDS)
def env(request):
    return envs.make(request.param)


@pytest.fixture(scope="module")
def start(env):
    return jax.jit(env.reset)(jax.random.key(0))


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


def equal(x, y):
    jax.tree.map(np.testing.assert_array_equal, x, y)


def test_shapes_and_dtypes_stay(env, start, step):
    after = step(start, jnp.zeros(env.action_size))
    before, later = jax.tree.map(lambda x: (x.shape, x.dtype), (start, after))
    assert before == later
    assert start.obs.shape == (env.observation_size,) == (observation_size(env),)
    assert start.reward.shape == start.done.shape == ()
    assert isinstance(env, Environment)


def test_bounds_and_limits(env):
    space = action_space(env)
    assert space.low.shape == space.high.shape == (env.action_size,)
    assert np.all(space.low < space.high)
    assert env.max_episode_steps > 0
    assert env.dt > 0


def test_step_does_not_modify_its_argument(env, start, step):
    copy = jax.tree.map(np.array, start)
    step(start, jnp.ones(env.action_size))
    equal(copy, start)


def test_the_same_key_is_the_same_episode(env, step):
    reset = jax.jit(env.reset)
    first, second, other = (reset(jax.random.key(seed)) for seed in (3, 3, 4))
    equal(first, second)
    assert np.any(first.obs != other.obs)
    action = jnp.full(env.action_size, 0.1)
    equal(step(first, action), step(second, action))


def test_set_state_is_where_reset_leads(env, start):
    physics = start.pipeline_state
    equal(jax.jit(env.set_state)(physics.qpos, physics.qvel), start)


def test_it_runs_under_brax(env):
    """Their wrappers and rollout, on ours, with the raw keys they need."""
    from brax.training import acting

    wrapped = wrappers.training.wrap(env, episode_length=5, action_repeat=1)
    states = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 4))

    def policy(observation, key):
        return jax.random.uniform(key, (*observation.shape[:-1], env.action_size)), {}

    last, data = jax.jit(
        lambda states, key: acting.generate_unroll(wrapped, states, policy, key, unroll_length=12)
    )(states, jax.random.PRNGKey(1))
    assert data.observation.shape == (12, 4, env.observation_size)
    assert np.all(np.isfinite(data.observation))
    assert np.all(last.info["steps"] <= 5)


def test_unknown_names_are_explained():
    with pytest.raises(ValueError, match="Did you mean 'InvertedPendulum-v5'"):
        envs.make("InvertedPendulm-v5")


def test_register_once():
    envs.register("Again-v0", envs.make, id="InvertedPendulum-v5")
    try:
        assert "Again-v0" in envs.names()
        with pytest.raises(ValueError, match="already registered"):
            envs.register("Again-v0", envs.make)
    finally:
        del envs._TABLE["Again-v0"]


def test_own_model_by_path(tmp_path):
    source = envs.make("InvertedPendulum-v5").mj_model
    mujoco.mj_saveLastXML(str(tmp_path / "mine.xml"), source)
    mine = envs.make("InvertedPendulum-v5", xml_file=str(tmp_path / "mine.xml"), frame_skip=1)
    assert mine.dt == pytest.approx(0.02)
