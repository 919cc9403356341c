"""The environments as brax's trainers take them: what its own wrappers show, and a training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import wrap
from brax.training.agents.ppo import train as ppo
from toys import Drifting

from mjx_reinforce import Box, Discrete, envs, make_vec
from mjx_reinforce.engine.vector.for_brax import BraxVectorEnv

CART = "ContinuousCartPole-v0"


def made(env, num_envs, **options):
    return BraxVectorEnv(make_vec(env, num_envs, autoreset="same_step", **options))


@pytest.mark.slow
def test_brax_sees_the_environments_as_its_wrappers_show_them():
    """The same starts and actions: its rewards, ends and observations, until an episode ends."""
    ours = made(CART, 4, max_episode_steps=15)
    theirs = wrap(envs.make(CART), episode_length=15)
    keys = jax.random.split(jax.random.PRNGKey(0), 4)  # brax knows no others
    mine = ours.reset(keys)
    other = theirs.reset(jax.vmap(lambda key: jax.random.split(key)[1])(keys))
    assert (ours.observation_size, ours.action_size) == (4, 1)
    np.testing.assert_allclose(mine.obs, other.obs, atol=1e-6)
    action = jnp.array([[0.0], [0.01], [-0.01], [1.0]])
    step, their_step = jax.jit(ours.step), jax.jit(theirs.step)
    running = np.ones(4, bool)
    cut = 0
    for _ in range(15):
        mine, other = step(mine, action), their_step(other, action * ours.vec.action_space.high)
        for name in ("reward", "done"):
            found, expected = getattr(mine, name), getattr(other, name)
            np.testing.assert_allclose(found[running], expected[running], atol=1e-5)
        for name in ("truncation", "episode_done"):
            np.testing.assert_array_equal(mine.info[name][running], other.info[name][running])
        found, expected = (x.info["episode_metrics"] for x in (mine, other))
        for name in ("sum_reward", "length"):
            np.testing.assert_allclose(found[name][running], expected[name][running], atol=1e-4)
        cut += int(mine.info["truncation"][running].sum())
        running &= np.asarray(mine.done) == 0
        np.testing.assert_allclose(mine.obs[running], other.obs[running], atol=1e-4)
    assert 0 < cut < 4


def test_a_new_episode_has_a_new_start():
    env = made(CART, 3, max_episode_steps=2)
    state = env.reset(jax.random.key(0))
    starts = [state.obs]
    for _ in range(4):
        state = jax.jit(env.step)(state, jnp.zeros((3, 1)))
        if state.done.all():
            starts.append(state.obs)
    assert len(np.unique(np.concatenate(starts), axis=0)) == 9


def test_actions_have_bounds():
    for space in (Discrete(2), Box(np.array([-np.inf]), np.array([1.0]))):
        with pytest.raises(ValueError, match="actions must have bounds"):
            made(Drifting(space), 2)


def test_episodes_begin_in_the_step_that_ends_one():
    with pytest.raises(ValueError, match="autoreset must be 'same_step' for brax, got 'next_step'"):
        BraxVectorEnv(make_vec(CART, 2))


@pytest.mark.slow
def test_its_ppo_trains(monkeypatch):
    """With the function that brax 0.14.2 calls and JAX 0.10 has no more (docs/vector.md)."""
    monkeypatch.setattr(
        jax,
        "device_put_replicated",
        lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree),
        raising=False,
    )
    told = []
    ppo.train(
        made(CART, 16),
        num_timesteps=4_000,
        num_evals=2,
        num_envs=16,
        num_eval_envs=16,
        wrap_env=False,
        episode_length=500,
        unroll_length=5,
        batch_size=16,
        num_minibatches=2,
        progress_fn=lambda steps, metrics: told.append((steps, metrics["eval/episode_reward"])),
    )
    assert [steps >= 4_000 for steps, _ in told] == [False, True]
    assert all(8 < reward < 500 for _, reward in told)
