"""The environments under Stable-Baselines3's interface: infos, seeds, and its own trainers."""

import jax
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize
from toys import Drifting

from mjx_reinforce import Box, make_vec
from mjx_reinforce.vector import for_stable_baselines3

SPACE = Box(np.array([-3.0]), np.array([1.0]))


def test_spaces_shapes_and_types_are_those_of_gymnasium():
    ours = for_stable_baselines3.make("InvertedPendulum-v5", 3)
    theirs = make_vec_env("InvertedPendulum-v5", 3)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space.shape == theirs.observation_space.shape
    assert ours.reset().shape == theirs.reset().shape
    for mine, other in zip(
        ours.step(np.zeros((3, 1), np.float32)), theirs.step(np.zeros((3, 1))), strict=True
    ):
        assert type(mine) is type(other)
        assert np.shape(mine) == np.shape(other)
        if isinstance(mine, np.ndarray):
            assert mine.dtype.kind == other.dtype.kind


def test_infos_are_those_of_a_monitor():
    """Against the environments in JAX: returns, lengths, last observations and time limits."""
    vec = make_vec(Drifting(SPACE), 5, autoreset="same_step", max_episode_steps=12)
    env = for_stable_baselines3.make(Drifting(SPACE), 5, max_episode_steps=12)
    env.seed(3)
    obs = env.reset()
    state = vec.reset(jax.vmap(jax.random.key)(np.arange(3, 8)))
    np.testing.assert_array_equal(obs, state.obs)
    cut = ended = 0
    step = jax.jit(vec.step)
    for action in jax.vmap(vec.sample_actions)(jax.random.split(jax.random.key(1), 60)):
        state = step(state, action)
        obs, reward, done, infos = env.step(np.asarray(action))
        np.testing.assert_array_equal(obs, state.obs)
        np.testing.assert_array_equal(reward, state.reward)
        np.testing.assert_array_equal(done, state.done)
        for i, info in enumerate(infos):
            if not done[i]:
                assert info == {}
                continue
            assert info["TimeLimit.truncated"] is bool(state.truncated[i] & ~state.terminated[i])
            np.testing.assert_array_equal(info["terminal_observation"], state.final_obs[i])
            assert info["episode"]["l"] == state.episode_length[i]
            assert info["episode"]["r"] == pytest.approx(float(state.episode_return[i]), abs=1e-6)
            assert info["episode"]["t"] > 0
            cut += info["TimeLimit.truncated"]
            ended += 1
    assert 0 < cut < ended


def test_what_was_handed_out_stays():
    env = for_stable_baselines3.make("CartPole-v1", 4, max_episode_steps=3)
    env.seed(0)
    env.reset()
    found = [env.step(np.ones(4, int)) for _ in range(3)]
    last = [info["terminal_observation"] for info in found[-1][3]]
    kept = [np.array(x) for x in (*last, *(one for step in found for one in step[:3]))]
    for _ in range(9):
        env.step(np.zeros(4, int))
    for x, y in zip((*last, *(one for step in found for one in step[:3])), kept, strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_seed_is_for_one_reset_and_one_environment():
    env = for_stable_baselines3.make("CartPole-v1", 3)
    env.seed(7)
    first = env.reset()
    assert len(np.unique(first, axis=0)) == 3
    assert np.all(env.reset() != first)
    env.seed(8)
    np.testing.assert_array_equal(env.reset()[:2], first[1:])
    env.seed(2**32 - 1)
    env.reset()
    assert len(env.seed()) == 3


def test_a_broken_simulation_leaves_numbers():
    class Breaking(Drifting):
        def step(self, state, action):
            state = super().step(state, action)
            return state.replace(obs=state.obs * np.nan)

    env = for_stable_baselines3.make(Breaking(SPACE), 2)
    env.reset()
    obs, reward, done, infos = env.step(np.zeros((2, 1)))
    assert np.all(np.isfinite(obs))
    assert reward.tolist() == [0, 0]
    assert done.all()
    assert all(np.all(info["terminal_observation"] == 0) for info in infos)
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_attributes_methods_and_wrappers():
    env = for_stable_baselines3.make("InvertedPendulum-v5", 3)
    assert env.get_attr("dt") == [pytest.approx(0.04)] * 3
    assert env.get_attr("render_mode", [0, 2]) == [None, None]
    assert env.has_attr("dt")
    assert not env.has_attr("nothing")
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(VecNormalize, 0) == [False]
    with pytest.raises(NotImplementedError, match="dt cannot be set"):
        env.set_attr("dt", 1)
    with pytest.raises(TypeError, match="autoreset"):
        for_stable_baselines3.make("InvertedPendulum-v5", 3, autoreset="next_step")
    env.reset()
    with pytest.raises(ValueError, match="must be finite numbers"):
        env.step(np.full((3, 1), np.nan))


def test_closed_twice():
    env = for_stable_baselines3.make("CartPole-v1", 2)
    env.reset()
    env.close()
    env.close()


@pytest.mark.filterwarnings("ignore")
def test_its_trainers_train_and_evaluate():
    """Statistics of episodes arrive, and a normaliser and a judge of policies work on them."""
    torch.set_num_threads(1)
    env = VecNormalize(for_stable_baselines3.make("InvertedPendulum-v5", 8))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=128, n_epochs=5, seed=0, device="cpu")
    model.learn(2_048)
    told = model.ep_info_buffer
    assert len(told) > 20
    assert all(one["l"] - one["r"] in (0, 1) for one in told)  # the step that falls earns nothing
    mean, _ = evaluate_policy(model, env, n_eval_episodes=8)
    assert mean > 3
    SAC("MlpPolicy", env, learning_starts=50, device="cpu").learn(80)
