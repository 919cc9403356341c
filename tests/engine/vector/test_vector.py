"""Many environments at once: episodes follow each other as Gymnasium says, on every engine."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper, VmapWrapper
from toys import Drifting

from experiments.checks.vector_parity import GymnasiumSide, compare
from mjx_reinforce import Box, envs, make_vec
from mjx_reinforce.engine.vector.environment import AUTORESETS

SPACE = Box(np.array([-3.0]), np.array([1.0]))


def play(vec, steps, seed=0, actions_seed=1):
    """The states [steps, N, ...] behind the first one, under random actions, and the actions."""
    actions = jax.vmap(vec.sample_actions)(jax.random.split(jax.random.key(actions_seed), steps))

    @jax.jit
    def all_steps(key, actions):
        def step(state, action):
            state = vec.step(state, action)
            return state, state

        start = vec.reset(key)
        return start, jax.lax.scan(step, start, actions)[1]

    start, states = all_steps(jax.random.key(seed), actions)
    return start, states, actions


def assert_close(got, want, rounding):
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=rounding, atol=rounding)


@pytest.mark.parametrize(
    ("engine", "autoreset"), [*(("native", x) for x in AUTORESETS), ("vmap", "same_step")]
)
def test_episodes_follow_each_other(engine, autoreset):
    """Against a loop over environments, one at a time, that does what Gymnasium documents."""
    env, steps, num = Drifting(SPACE), 25, 5
    vec = make_vec(env, num, autoreset=autoreset, max_episode_steps=7, engine=engine)
    start, states, actions = play(vec, steps)
    step, reset = jax.jit(env.step), jax.jit(env.reset)
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(0)))(jnp.arange(num))
    ends = 0
    for i in range(num):
        key, reset_key = jax.random.split(keys[i])
        at = reset(reset_key)
        np.testing.assert_allclose(start.obs[i], at.obs, rtol=1e-6)
        length, total, over = 0, 0.0, False
        for t in range(steps):
            one = jax.tree.map(lambda x, i=i, t=t: x[t, i], states)
            if over and autoreset != "disabled":
                length, total = 0, 0.0
            if over and autoreset == "next_step":
                key, reset_key = jax.random.split(key)
                at = reset(reset_key)
                np.testing.assert_allclose(one.obs, at.obs, rtol=1e-5, atol=1e-6)
                assert (float(one.reward), bool(one.done), int(one.episode_length)) == (0, False, 0)
                over = False
                continue
            if over and autoreset == "disabled":
                length, total = 0, 0.0
            at = step(at, actions[t, i])
            length, total = length + 1, total + float(at.reward)
            over = bool(at.done) or length == 7
            ends += over
            np.testing.assert_allclose(one.final_obs, at.obs, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(one.reward, at.reward, rtol=1e-5, atol=1e-6)
            assert bool(one.terminated) == bool(at.done)
            assert bool(one.truncated) == (length == 7)
            assert int(one.episode_length) == length
            np.testing.assert_allclose(one.episode_return, total, rtol=1e-5, atol=1e-5)
            if over and autoreset == "same_step":
                key, reset_key = jax.random.split(key)
                at = reset(reset_key)
            np.testing.assert_allclose(one.obs, at.obs, rtol=1e-5, atol=1e-6)
    assert ends > 2 * num


@pytest.mark.cpu
@pytest.mark.slow
def test_machine_code_computes_the_same_for_any_number():
    env = envs.make("InvertedPendulum-v5")
    actions = jax.random.uniform(jax.random.key(1), (40, 37, 1), minval=-3, maxval=3)
    found = []
    for num in (3, 37):
        vec = make_vec(env, num)
        assert vec.engine.name == "native"
        state = jax.jit(vec.reset)(jax.random.key(0))
        step, kept = jax.jit(vec.step), []
        for action in actions[:, :num]:
            state = step(state, action)
            kept.append(state)
        found.append(jax.tree.map(lambda *x: np.stack(x)[:, :3], *kept))
    assert np.any(found[0].terminated)
    assert_close(*found, 0)


@pytest.mark.slow
def test_mapped_over_and_restarted():
    vec = make_vec("CartPole-v1", 6)
    keys = jax.random.split(jax.random.key(5), 2)
    both = jax.jit(jax.vmap(vec.reset))(keys)
    alone = jax.vmap(vec.reset)(keys[1:])
    np.testing.assert_array_equal(both.obs[1], alone.obs[0])
    action = jnp.ones((2, 6), jnp.int32)
    after = jax.jit(jax.vmap(vec.step))(both, action)
    assert_close(
        jax.tree.map(lambda x: x[0], after),
        vec.step(jax.tree.map(lambda x: x[0], both), action[0]),
        0,
    )
    one = jax.tree.map(lambda x: x[0], after)
    again = vec.restart(one, np.arange(6) < 2)
    assert again.episode_length.tolist() == [0, 0, 1, 1, 1, 1]
    np.testing.assert_array_equal(again.obs[2:], one.obs[2:])
    assert np.all(again.obs[:2] != one.obs[:2])


def test_a_number_that_is_not_finite_ends_the_episode():
    vec = make_vec("InvertedPendulum-v5", 4)
    state = jax.jit(vec.reset)(jax.random.key(0))
    action = jnp.zeros((4, 1)).at[2].set(jnp.nan)
    after = jax.jit(vec.step)(state, action)
    assert after.nonfinite.tolist() == after.terminated.tolist() == [False, False, True, False]
    assert after.reward.tolist() == [1, 1, 0, 1]
    then = jax.jit(vec.step)(after, jnp.zeros((4, 1)))
    assert np.all(np.isfinite(then.obs))
    assert then.episode_length.tolist() == [2, 2, 0, 2]


@pytest.mark.parametrize("engine", ["native", "vmap"])
def test_a_time_limit_of_the_environments_own_truncates(engine):
    """The wrapper of brax sets ``done`` at 12 steps; a cart that is only pushed falls before."""
    env = EpisodeWrapper(envs.make("CartPole-v1"), episode_length=12, action_repeat=1)
    vec = make_vec(env, 2, autoreset="same_step", engine=engine)
    state, step = vec.reset(jax.random.key(0)), jax.jit(vec.step)
    ends = []
    for t in range(12):
        state = step(state, jnp.array([t % 2, 1]))
        ends.append((state.terminated, state.truncated))
    terminated, truncated = np.array(ends).swapaxes(0, 1)  # [12, 2] each
    assert terminated.sum(0).tolist() == [0, 1]
    assert truncated.sum(0).tolist() == [1, 0]
    assert np.abs(state.final_obs[0] - state.obs[0]).max() > 0.05


@pytest.mark.parametrize("wrapper", [VmapWrapper, AutoResetWrapper])
def test_what_begins_episodes_by_itself_is_refused(wrapper):
    """What an action led to would be the next start."""
    env = EpisodeWrapper(wrapper(envs.make("CartPole-v1")), episode_length=12, action_repeat=1)
    with pytest.raises(ValueError, match=f"{wrapper.__name__} does what is done here"):
        make_vec(env, 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"num_envs": 10**12}, r"num_envs must be less than 2\^31, got 1000000000000"),
        ({"num_envs": 2**30}, "environments need .* make at most"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ({"reset_noise": 1}, "reset_noise.*[^']$"),
        ({"autorest": "same_step"}, "'autorest'.* Known: "),
        ({"env": Drifting(SPACE), "reset_noise": 1}, "are for an id"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_vec(**({"env": "CartPole-v1", "num_envs": 2} | arguments))


@pytest.mark.slow
def test_bad_keys_actions_and_states():
    vec = make_vec("InvertedPendulum-v5", 4)
    state = vec.reset(jax.random.key(0))
    for action, message in (
        (jnp.zeros((4, 2)), r"must be \[4, 1\], got the shape \[4, 2\]"),
        (jnp.zeros(4), r"must be \[4, 1\], got the shape \[4\]"),
        (jnp.zeros((4, 1), complex), "must be float32, got complex64"),
    ):
        with pytest.raises(ValueError, match=message):
            vec.step(state, action)
    with pytest.raises(ValueError, match=r"is not of VectorEnv\(5 x"):
        make_vec("InvertedPendulum-v5", 5).step(state, jnp.zeros((5, 1)))
    with pytest.raises(ValueError, match="must be a random key"):
        vec.reset(7)
    with pytest.raises(ValueError, match="the generator rbg"):
        vec.reset(jax.random.key(0, impl="rbg"))
    with pytest.raises(ValueError, match=r"must be int32, got float32"):
        make_vec("CartPole-v1", 4).step(None, jnp.zeros(4))
    other = make_vec("CartPole-v1", 4).reset(jax.random.key(0))
    for wrong, message in (
        (state.obs, "must be what reset or step returned, got a"),
        (None, "got a NoneType"),
        ((state, 1), "got a tuple"),
        (other, r"is not of VectorEnv\(4 x InvertedPendulum"),
        (state.replace(final_obs=state.final_obs[:, :2]), "or was changed"),
        (state.replace(reward=state.reward.astype(int)), "or was changed"),
        (jax.tree.map(lambda x: x[0], state), "or was changed"),
    ):
        with pytest.raises(ValueError, match=message):
            jax.jit(vec.step)(wrong, jnp.zeros((4, 1)))


@pytest.mark.cpu
def test_why_an_engine_was_chosen():
    assert make_vec("CartPole-v1", 2).engine.why == "machine code for this CPU"
    assert make_vec("CartPole-v1", 2, engine="vmap").engine.why == "chosen by name"


@pytest.mark.slow
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_parity_with_gymnasium(autoreset):
    """In double precision, step by step, through ends of episodes and resets."""
    with jax.enable_x64(True):
        vec = make_vec("InvertedPendulum-v5", 6, autoreset=autoreset, max_episode_steps=30)
        apart = compare(vec, GymnasiumSide("InvertedPendulum-v5", 6, 30, autoreset), 80)
    assert max(apart.observation, apart.reward, apart.final) < 1e-6
    assert (apart.final > 0) == (autoreset == "same_step")
    assert apart.flags == 0
    assert apart.ends > 6
