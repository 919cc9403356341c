"""The environments with torch's tensors, beside the engine: the contract of RSL-RL's ``VecEnv``."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Drifting

from mjx_reinforce import Box, make_vec

SPACE = Box(np.array([-3.0]), np.array([1.0]))
NUM_ENVS = 5
LIMIT = 7


def test_without_torch_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "mjx_reinforce.engine.vector.for_torch", raising=False)
    with pytest.raises(ValueError, match=r"pip install 'mjx-reinforce\[rsl-rl\]'"):
        make_vec("CartPole-v1", 2, framework="torch")


@pytest.mark.parametrize("framework", ["tensorflow", None])
def test_another_framework_is_refused(framework):
    with pytest.raises(ValueError, match=rf"unknown framework '{framework}'\. Known: jax, torch"):
        make_vec("CartPole-v1", 2, framework=framework)


@pytest.fixture(scope="module")
def torch():
    pytest.importorskip("tensordict")
    return pytest.importorskip("torch")


@pytest.fixture(scope="module")
def env(torch):
    task = Drifting(SPACE, length=5.0)
    return make_vec(task, NUM_ENVS, framework="torch", max_episode_steps=LIMIT)


def test_it_plays_what_the_engine_plays(torch, env):
    """Bit by bit, through ends of both kinds and the starts behind them."""
    vec = env.vec
    assert vec.autoreset == "same_step"
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (NUM_ENVS, 1, LIMIT)
    state = vec.reset(jax.random.key(8))
    observation, _ = env.reset(seed=8)
    step = jax.jit(vec.step)
    flags = []
    for key in jax.random.split(jax.random.key(1), 25):
        np.testing.assert_array_equal(observation["policy"], state.obs)
        action = vec.sample_actions(key)
        state = step(state, action)
        observation, reward, done, extras = env.step(torch.tensor(np.array(action)))
        np.testing.assert_array_equal(reward, state.reward)
        np.testing.assert_array_equal(done, state.done)
        np.testing.assert_array_equal(extras["time_outs"], state.truncated & ~state.terminated)
        np.testing.assert_array_equal(
            env.episode_length_buf, jnp.where(state.done, 0, state.episode_length)
        )
        flags.append((bool(extras["time_outs"].any()), bool(state.terminated.any())))
        assert not extras["log"]["/nonfinite"].any()
    assert np.all(np.any(flags, axis=0))
    assert observation.batch_size == (NUM_ENVS,)


def test_tensors_are_not_copied(torch, env):
    observation, reward, *_ = env.step(torch.zeros(NUM_ENVS, 1))
    assert observation["policy"].data_ptr() == env.state.obs.unsafe_buffer_pointer()
    assert reward.data_ptr() == env.state.reward.unsafe_buffer_pointer()
    before = observation["policy"].clone()
    env.step(torch.zeros(NUM_ENVS, 1))
    assert torch.equal(observation["policy"], before)  # it was not written over


def test_lengths_of_episodes_are_set(torch, env):
    """As RSL-RL does before training, so that time limits come one after the other."""
    env.reset()
    lengths = torch.tensor([0, 6, 3, 6, 0])
    env.episode_length_buf = lengths
    lengths += 100  # the environments have their own
    assert env.episode_length_buf.tolist() == [0, 6, 3, 6, 0]
    _, _, done, extras = env.step(torch.zeros(NUM_ENVS, 1))
    assert done.tolist() == extras["time_outs"].tolist() == [False, True, False, True, False]
    assert env.episode_length_buf.tolist() == [1, 0, 4, 0, 1]
    with pytest.raises(ValueError, match=r"must be integers \[5\], got torch.float32 \[5\]"):
        env.episode_length_buf = torch.zeros(NUM_ENVS)


def test_lengths_are_set_where_episodes_have_just_ended(torch, env):
    env.reset()
    for _ in range(LIMIT):
        _, _, done, _ = env.step(torch.zeros(NUM_ENVS, 1))
    assert done.any()
    env.episode_length_buf = torch.full((NUM_ENVS,), 5)
    env.step(torch.zeros(NUM_ENVS, 1))
    assert env.episode_length_buf.tolist() == [6] * NUM_ENVS


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ("zeros(5)", r"must be torch.float32 \[5, 1\] on cpu, got torch.float32 \[5\] on cpu"),
        ("zeros(5, 1, dtype=torch.float64)", r"got torch.float64 \[5, 1\]"),
        ("zeros(5, 1, dtype=torch.int64)", r"got torch.int64 \[5, 1\]"),
        ("zeros(5, 1, device='meta')", "on meta"),
        ("zeros(5, 1).numpy()", "must be a torch.Tensor, got a ndarray"),
        ("tensor([[0.0], [0.0], [float('nan')], [0.0], [0.0]])", r"got nan at \(2, 0\)"),
    ],
)
def test_bad_actions(torch, env, actions, message):
    before = env.state
    with pytest.raises(ValueError, match=message):
        env.step(eval(f"torch.{actions}", {"torch": torch}))
    assert env.state is before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "CartPole-v1"}, "CartPole has discrete ones"),
        ({"autoreset": "next_step"}, "autoreset must be same_step, got next_step"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
    ],
)
def test_bad_arguments(torch, arguments, message):
    with pytest.raises(ValueError, match=message):
        make_vec(**({"env": Drifting(SPACE), "num_envs": 2, "framework": "torch"} | arguments))


def test_a_task_without_a_time_limit(torch):
    task = Drifting(SPACE)
    task.max_episode_steps = None
    with pytest.raises(ValueError, match="Drifting has no time limit"):
        make_vec(task, 2, framework="torch")


@pytest.mark.slow
def test_rsl_rl_trains(torch, capsys):
    """A cart's pole falls after some 10 to 30 steps, and stays up for longer after a training."""
    pytest.importorskip("rsl_rl")
    from experiments.examples import rsl_rl_ppo

    sizes = {"iterations": 15, "num_envs": 64, "num_steps": 32, "reports": 1}
    rsl_rl_ppo.main(rsl_rl_ppo.Settings(env="InvertedPendulum-v5", **sizes))
    lines = [x for x in capsys.readouterr().out.splitlines() if " steps " in x]
    before, after = (float(line.split()[-1]) for line in lines)
    assert after > 2 * before
