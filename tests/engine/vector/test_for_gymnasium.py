"""The environments under Gymnasium's interface: found by its name, and what its own tests ask."""

import pickle
import subprocess
import sys

import gymnasium
import jax
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mjx_reinforce import envs, gym

CART, REACHER = "mjx_reinforce/CartPole-v1", "mjx_reinforce/Reacher-v5"
PENDULUM = "mjx_reinforce/InvertedPendulum-v5"


@pytest.fixture
def cart():
    env = gymnasium.make_vec(f"mjx_reinforce.gym:{CART}", num_envs=3)  # an id can name the module
    yield env
    env.close()


def play(env, steps=30, seed=0):
    env.action_space.seed(seed)
    found = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        found.append(env.step(env.action_space.sample())[0])
    return np.stack(found)


def test_gymnasium_knows_every_task():
    """JAX is not imported before a task is made."""
    code = (
        "import gymnasium, sys, mjx_reinforce.gym; "
        "ours = [id for id in gymnasium.registry if id.startswith('mjx_reinforce/')]; "
        "print(len(ours), 'jax' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert said.stdout.split() == [str(len(envs.names())), "False"]


def test_shapes_spaces_and_metadata(cart):
    assert cart.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert (cart.num_envs, cart.spec.id) == (3, CART)
    assert cart.spec.max_episode_steps == cart.unwrapped.vec.max_episode_steps == 500
    assert cart.single_action_space == gymnasium.spaces.Discrete(2)
    assert cart.observation_space.shape == (3, 4)
    observation, info = cart.reset(seed=1)
    assert info == {}
    assert observation in cart.observation_space
    observation, reward, terminated, truncated, info = cart.step(cart.action_space.sample())
    assert observation in cart.observation_space
    assert (reward.shape, terminated.dtype, truncated.dtype) == ((3,), bool, bool)
    assert all(f"_{name}" in info for name in info if not name.startswith("_"))


def test_seeds(cart):
    first = play(cart)
    np.testing.assert_array_equal(play(cart), first)
    assert np.any(play(cart, seed=1) != first)
    assert len(np.unique(first[0], axis=0)) == 3
    one_each = cart.reset(seed=[5, 6, 5])[0]
    np.testing.assert_array_equal(one_each[0], one_each[2])
    assert np.any(one_each[0] != one_each[1])
    assert np.any(cart.reset()[0] != one_each)  # goes on drawing


def test_some_are_reset(cart):
    cart.reset(seed=0)
    before = cart.step(np.ones(3, int))[0]
    mask = np.array([True, False, False])
    after = cart.reset(seed=3, options={"reset_mask": mask})[0]
    np.testing.assert_array_equal(after[1:], before[1:])
    assert np.any(after[0] != before[0])
    whole = cart.reset(seed=5)[0]
    cart.reset(seed=0)
    some = cart.reset(seed=5, options={"reset_mask": np.array([True, False, True])})[0]
    np.testing.assert_array_equal(some[[0, 2]], whole[[0, 2]])  # as if all were reset
    assert np.any(some[0] != some[2])
    with pytest.raises(ValueError, match="must be a bool array"):
        cart.reset(options={"reset_mask": [True]})
    with pytest.raises(ValueError, match="unknown option 'reset_maks'; known: 'reset_mask'"):
        cart.reset(options={"reset_maks": mask})


def test_a_seed_of_one_is_that_of_its_environment(cart):
    """However many there are; one number is the first of several, as in Gymnasium."""
    alone = gymnasium.make_vec(CART, num_envs=1)
    several = cart.reset(seed=[4, 5, 6])[0]
    np.testing.assert_array_equal(alone.reset(seed=[5])[0][0], several[1])
    np.testing.assert_array_equal(cart.reset(seed=4)[0], several)
    own = gymnasium.make_vec("CartPole-v1", num_envs=3, vectorization_mode="sync")
    np.testing.assert_array_equal(own.reset(seed=4)[0], own.reset(seed=[4, 5, 6])[0])


@pytest.mark.slow
def test_without_autoreset_what_has_ended_is_reset_first():
    """As in Gymnasium, which raises an AssertionError."""
    make = {"num_envs": 2, "autoreset": "disabled", "max_episode_steps": 3}
    env, actions = gymnasium.make_vec(PENDULUM, **make), np.array([[0.0], [3.0]])
    env.reset(seed=0)
    for _ in range(3):
        *_, terminated, truncated, _ = env.step(actions)
        over = terminated | truncated
    assert over.all()
    with pytest.raises(ValueError, match=r"2 of 2 environments .* as 0; .*reset_mask"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="1 of 2 environments have ended, such as 1;"):
        env.step(actions)
    env.reset(options={"reset_mask": over})
    assert not np.any(env.step(actions)[3])


def test_same_step_tells_the_last_observation():
    env = gymnasium.make_vec(CART, num_envs=3, autoreset="same_step", max_episode_steps=4)
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(np.array([0, 1, 0]))
        assert "final_obs" not in info
    observation, _, _, truncated, info = env.step(np.array([0, 1, 0]))
    assert truncated.all()
    assert info["_final_obs"].all()
    assert info["final_obs"].dtype == object
    assert np.all(np.abs(observation) <= 0.05)
    assert np.abs(np.stack(info["final_obs"])).max() > 0.05


@pytest.mark.slow
def test_same_step_tells_the_terms_of_every_step():
    """Those of a step that ended an episode are apart, as Gymnasium has it."""
    make = {"num_envs": 2, "autoreset": "same_step", "max_episode_steps": 3}
    env = gymnasium.make_vec("mjx_reinforce/InvertedPendulum-v5", **make)
    env.reset(seed=0)
    for t in range(1, 7):
        *_, info = env.step(np.zeros((2, 1)))
        ended = t % 3 == 0
        assert info["_reward_survive"].tolist() == [not ended] * 2
        assert ("final_info" in info) == ended
        told = info["final_info"] if ended else info
        assert told["reward_survive"].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("env_id", "actions", "message"),
    [
        (PENDULUM, np.full((2, 1), np.nan), r"must be finite numbers, got nan at \(0, 0\)"),
        (PENDULUM, np.zeros((2, 4)), r"must be \[2, 1\], got the shape \[2, 4\]"),
        (CART, np.array([0, 2]), "must be 0 to 1, got 2"),
        (CART, np.zeros(2), "must be int32, got float"),
        (CART, np.array(["left", "right"]), "must be numbers"),
    ],
)
def test_bad_actions(env_id, actions, message):
    env = gymnasium.make_vec(env_id, num_envs=2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(actions)


@pytest.mark.slow
def test_out_of_range_is_clamped_by_the_actuators_alone():
    """As in Gymnasium: the body gets 1, the reward pays for 5."""
    env = gymnasium.make_vec(REACHER, num_envs=1)
    found = []
    for size in (1.0, 5.0):
        env.reset(seed=0)
        found.append(env.step(np.full((1, 2), size)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[1][4]["reward_ctrl"], -50, rtol=1e-5)


def test_wrong_order_and_bad_arguments(cart):
    with pytest.raises(ValueError, match="call reset before step"):
        cart.step(np.zeros(3, int))
    with pytest.raises(ValueError, match="or a list of 3, one each"):
        cart.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="render_mode"):
        gymnasium.make_vec(CART, num_envs=1, render_mode="human")
    with pytest.raises(ValueError, match="no MuJoCo model"):
        gymnasium.make_vec(CART, num_envs=1, render_mode="rgb_array")
    with pytest.raises(ValueError, match="arrays"):
        gym.make("CartPole-v1", 1, arrays="list")
    with pytest.raises(ValueError, match=r"gymnasium\.make_vec\('mjx_reinforce/CartPole-v1'"):
        gymnasium.make(CART)
    with pytest.raises(TypeError, match="make it where it is used"):
        pickle.dumps(gym.make("CartPole-v1", 1))
    for seed in (1.5, True, "abc"):
        with pytest.raises(ValueError, match="seed must be a whole number"):
            cart.reset(seed=seed)


def test_closed_twice(cart):
    cart.reset(seed=0)
    cart.close()
    cart.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="make another"):
        cart.step(np.zeros(3, int))


def test_jax_arrays_are_handed_out_as_they_are():
    env = gym.make("InvertedPendulum-v5", 2, arrays="jax")
    first, _ = env.reset(seed=0)
    assert isinstance(first, jax.Array)
    kept = np.array(first)
    second, *_ = env.step(np.zeros((2, 1), np.float32))
    assert env.state.obs is second
    np.testing.assert_array_equal(first, kept)  # it was not written over


def test_torch_tensors_are_not_copied():
    torch = pytest.importorskip("torch")
    env = gym.make("InvertedPendulum-v5", 2, arrays="torch")
    env.reset(seed=0)
    observation, reward, *_ = env.step(torch.zeros((2, 1)))
    assert isinstance(reward, torch.Tensor)
    assert observation.data_ptr() == env.state.obs.unsafe_buffer_pointer()


#: Pictures of a pendulum, which moves, and of a cheetah 30 checkers on; the renderer is left open.
RENDERED = """
import types
import numpy as np
from mjx_reinforce import gym
env = gym.make("InvertedPendulum-v5", 2, render_mode="rgb_array")
assert env.render() is None
env.reset(seed=0)
(picture,) = env.render()
assert picture.shape == (240, 320, 3)
for _ in range(8):
    env.step(np.full((2, 1), 3.0))
assert np.any(env.render()[0] != picture)
env.close()
env = gym.make("HalfCheetah-v5", 2, engine="mujoco", render_mode="rgb_array")
pictures = []
for x in (0.0, 30 * 80 / 60):
    qpos = env.vec.env.mj_model.qpos0[None].copy()
    qpos[0, 0] = x
    there = types.SimpleNamespace(pipeline_state=types.SimpleNamespace(qpos=qpos))
    env.state = types.SimpleNamespace(simulation=there)
    pictures.append(env.render()[0].astype(int))
print(np.abs(pictures[0] - pictures[1]).mean(), pictures[0].std())
"""


@pytest.mark.slow
def test_rendered():
    """In its own process, which draws without a screen; the picture goes with the robot."""
    command = [sys.executable, "-c", RENDERED]
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    apart, spread = map(float, ran.stdout.split())
    assert apart < 2
    assert spread > 30
    assert ran.stderr == ""


def test_a_computer_that_cannot_draw_is_answered_at_once(monkeypatch):
    def fail(*arguments):
        raise RuntimeError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ValueError, match=r"MuJoCo cannot draw .* set MUJOCO_GL=egl,"):
        gym.make("InvertedPendulum-v5", 2, render_mode="rgb_array")


def test_seeds_of_64_bits(cart):
    """Those below 2^32 are `jax.random.key` of them; others are not those less 2^32."""
    vec = gym.make("CartPole-v1", 3).vec
    keys = jax.vmap(jax.random.key)(np.arange(7, 10))
    np.testing.assert_array_equal(cart.reset(seed=7)[0], vec.reset(keys).obs)
    assert np.any(cart.reset(seed=2**32 + 7)[0] != cart.reset(seed=7)[0])
    several = cart.reset(seed=[7, 2**32 + 7, 7])[0]
    np.testing.assert_array_equal(several[0], several[2])
    assert np.any(several[0] != several[1])
