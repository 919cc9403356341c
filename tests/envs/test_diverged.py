"""Simulations that diverge and stay finite: where C MuJoCo resets, the episode is broken."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_reinforce import make_vec, mlp_policy, normal, playing, rollout
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.in_mujoco import InMujoco
from mjx_reinforce.export.player import Player
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.policy import Actor

MODEL = """<mujoco><option timestep="0.01"/><worldbody>
    <body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.05"/></body></worldbody>
  <actuator><position joint="x" kp="{kp}" ctrlrange="-1 1"/></actuator></mujoco>"""
#: What leaves 1e10 first: the servo's stiffness, where it starts (m, m/s), and the physics step in
#: which C resets. It looks at positions and velocities when a step begins, ours when one ends.
CASES = {
    "qacc": (1e5, 0.01, 0.0, 7),
    "qvel": (2.0, -5e8, 9.95e9, 5),
    "qpos": (0.0, 9.81e9, 5e9, 5),
}
pytestmark = pytest.mark.filterwarnings("ignore:.*The simulation is unstable")


@pytest.fixture
def in_a_folder(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into a file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def still(env):
    """A policy whose mode is 0, and its parameters."""
    policy = mlp_policy(1, normal(env.action_space))
    return policy, jax.tree.map(jnp.zeros_like, policy.init(jax.random.key(0)))


class Slider(MujocoEnv):
    """Earns its speed, and shows nothing of what diverges."""

    def __init__(self, case="qacc", frame_skip=1):
        kp, *self.start, _ = CASES[case]
        super().__init__(
            xml_file=mujoco.MjModel.from_xml_string(MODEL.format(kp=kp)),  # pyright: ignore
            frame_skip=frame_skip,
            max_episode_steps=20,
            reward_threshold=None,
        )

    def initial(self, rng):
        return tuple(jnp.array([x]) for x in self.start)

    def observe(self, data):
        return data.time[None]

    def outcome(self, before, data, action):
        return jnp.abs(data.qvel[0]), False, {}


@pytest.mark.parametrize("case", CASES)
def test_a_step_in_which_c_resets_earns_no_number(case, in_a_folder):
    """Nor does one that goes on after it."""
    last = CASES[case][-1]
    peer = InMujoco(Slider(case))
    peer.reset(jax.random.key(0))
    speeds = [peer.step(np.zeros(1))[1] for _ in range(last)]
    assert np.isfinite(speeds).tolist() == [True] * (last - 1) + [False]
    env, found = Slider(case, frame_skip=3), []
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for _ in range(-(-(last - (case != "qacc")) // 3)):
        state = step(state, jnp.zeros(1))
        found.append(state.reward)
    np.testing.assert_allclose(found, [*speeds[2::3][: len(found) - 1], np.nan], rtol=1e-4)


@pytest.mark.parametrize("engine", [pytest.param("vmap", marks=pytest.mark.slow), "native"])
def test_every_engine_ends_the_episode(engine):
    env = Slider()
    policy, params = still(env)
    play = functools.partial(rollout, env, policy.apply, params, policy.distribution)
    options = {"num_episodes": 1, "horizon": 20, "engine": engine, "deterministic": True}
    episode = jax.jit(functools.partial(play, **options))(jax.random.key(0))
    assert episode.nonfinite.tolist() == [True]
    assert int(episode.mask.sum()) == CASES["qacc"][-1]
    assert 1e7 < episode.reward.max() < 1e8


@pytest.mark.slow
def test_many_at_once_are_told():
    vec = make_vec(Slider(), 2)
    state, step = vec.reset(jax.random.key(0)), jax.jit(vec.step)
    for _ in range(CASES["qacc"][-1]):
        assert not np.any(state.nonfinite)
        state = step(state, jnp.array([[0.0], [0.01]]))  # the second stays where it is
    assert state.nonfinite.tolist() == state.terminated.tolist() == [True, False]
    assert state.reward[0] == 0


def test_episodes_to_look_at_end_there():
    """In each simulation that ``watch`` knows."""
    env = Slider()
    policy, params = still(env)
    actor = Actor(params=params, normalizer=normalize.init(1))
    player = Player("Diverging-v0", 0, policy, actor)
    for simulator in (playing.simulator, playing.mujoco_simulator):
        episode = simulator(env, player, 20)(0, False)
        assert np.isnan(episode.rewards).tolist() == [False] * (len(episode.rewards) - 1) + [True]
        assert 4 < len(episode.rewards) == len(episode.qpos) < 10
