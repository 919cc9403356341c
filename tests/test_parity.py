"""One env step against the installed Gymnasium, in float64, and the models field by field."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import envs

NUM_STATES = 1000
#: Per task: qpos and qvel drawn within this of zero; the pendulum's rail ends at 1 m.
RANGES = {"InvertedPendulum": ([1.05, 0.25], [4.0, 4.0])}


def theirs(id):
    return gymnasium.make(id).unwrapped


@pytest.mark.parametrize("id", envs.names())
def test_model_equals_gymnasium_field_by_field(id):
    ours, expected = envs.make(id).mj_model, theirs(id).model
    compared = 0
    for name in dir(expected):
        value = getattr(expected, name)
        if not name.startswith("_") and isinstance(value, int | float | bytes | np.ndarray):
            np.testing.assert_array_equal(getattr(ours, name), value, err_msg=name)
            compared += 1
    for name in dir(expected.opt):
        value = getattr(expected.opt, name)
        if not name.startswith("_") and isinstance(value, int | float | np.ndarray):
            np.testing.assert_array_equal(getattr(ours.opt, name), value, err_msg=name)
            compared += 1
    assert compared > 300


def draw_states(id, env):
    """Random states, some beyond the joints' limits and some an instant before the fall."""
    random = np.random.default_rng(0)
    qpos_range, qvel_range = RANGES[id.split("-")[0]]
    qpos = random.uniform(-1, 1, (NUM_STATES, len(qpos_range))) * qpos_range
    qvel = random.uniform(-1, 1, (NUM_STATES, len(qvel_range))) * qvel_range
    low, high = env.action_space
    action = random.uniform(1.2 * low, 1.2 * high, (NUM_STATES, len(low)))
    return qpos, qvel, action


def gymnasium_step(env, qpos, qvel, action):
    env.reset(seed=0)
    env.set_state(qpos, qvel)
    observation, reward, terminated, _, _ = env.step(action)
    return env.data.qpos.copy(), env.data.qvel.copy(), observation, reward, terminated


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("id", envs.names())
def test_one_step_equals_gymnasium(id):
    with jax.enable_x64(True):
        env = envs.make(id)
        qpos, qvel, action = draw_states(id, env)

        def one(qpos, qvel, action):
            return env.step(env.set_state(qpos, qvel), action)

        ours = jax.jit(jax.vmap(one))(*map(jnp.asarray, (qpos, qvel, action)))
        assert ours.obs.dtype == jnp.float64
        reference = theirs(id)
        expected = [
            np.array(column)
            for column in zip(
                *(
                    gymnasium_step(reference, *case)
                    for case in zip(qpos, qvel, action, strict=True)
                ),
                strict=True,
            )
        ]
    physics = ours.pipeline_state
    np.testing.assert_allclose(physics.qpos, expected[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(physics.qvel, expected[1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.obs, expected[2], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(ours.reward, expected[3])
    np.testing.assert_array_equal(np.asarray(ours.done) == 1, expected[4])
    assert 0 < np.sum(expected[4]) < NUM_STATES
    assert np.any(np.abs(qpos[:, 0]) > 1)


@pytest.mark.parametrize("id", envs.names())
def test_reset_is_gymnasiums_distribution(id):
    env = envs.make(id)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000))
    physics = states.pipeline_state
    reference = theirs(id)
    draws = [reference.reset(seed=seed)[0] for seed in range(1000)]
    ours = np.concatenate([physics.qpos, physics.qvel], axis=1)
    from scipy import stats

    for i in range(ours.shape[1]):
        assert stats.ks_2samp(ours[:, i], np.array(draws)[:, i]).pvalue > 1e-3


def test_broken_state_ends_the_episode():
    env = envs.make("InvertedPendulum-v5")
    after = env.step(env.set_state(jnp.array([0.0, 0.0]), jnp.array([jnp.nan, 0.0])), jnp.zeros(1))
    assert float(after.done) == 1.0
    assert float(after.reward) == 0.0


@pytest.mark.parametrize(
    ("id", "at_fall"), [("InvertedPendulum-v5", 0.0), ("InvertedPendulum-v4", 1.0)]
)
def test_reward_of_the_fall(id, at_fall):
    env = envs.make(id)
    after = env.step(env.set_state(jnp.array([0.0, 0.25]), jnp.zeros(2)), jnp.zeros(1))
    assert float(after.done) == 1.0
    assert float(after.reward) == at_fall
