"""Robots that C MuJoCo plays best, by the device code with one lane on a CPU."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_reinforce as mr
from mjx_reinforce.engine.play import choice, cxx
from mjx_reinforce.envs.base import MujocoEnv

pytestmark = pytest.mark.skipif(cxx.compiler() is None, reason="there is no C++ compiler")

_SLED = """
<mujoco>
  <option timestep=".005" cone="elliptic"/>
  <asset><mesh name="wedge" vertex="-.2 -.1 0  .2 -.1 0  -.2 .1 0  .2 .1 0  -.2 0 .1"/></asset>
  <worldbody>
    <geom type="plane" size="9 9 .1"/>
    <body pos="0 0 .02">
      <freejoint/>
      <geom type="mesh" mesh="wedge" mass="1"/>
      <body pos="0 0 .1"><joint name="hip" axis="0 1 0" range="-60 60"/>
        <geom type="cylinder" size=".03 .1" pos="0 0 .12" mass=".2"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="hip" gear=".4" ctrlrange="-1 1"/></actuator>
</mujoco>"""


class Sled(MujocoEnv):
    """A hull on the floor that a swinging cylinder moves."""

    def __init__(self):
        super().__init__(
            xml_file=mujoco.MjModel.from_xml_string(_SLED),
            frame_skip=2,
            max_episode_steps=30,
            reward_threshold=None,
        )

    def initial(self, rng):
        speed = 0.1 * jax.random.normal(rng, (self.mj_model.nv,))
        return jnp.asarray(self.mj_model.qpos0, speed.dtype), speed

    def observe(self, data):
        return jnp.concatenate([data.qpos, data.qvel])

    def outcome(self, before, data, action):
        forward = data.qpos[0] - before.qpos[0]
        return forward, data.qpos[2] > 0.5, {"reward_forward": forward}


def _episodes(name, env, *, seeds=2, num_episodes=5):
    """Returns the engine of a name, and episodes [S, T, N] of seeds by it."""
    family = mr.normal(env.action_space)
    policy = mr.mlp_policy(env.observation_size, family, (8, 8))
    actor = policy.init(jax.random.key(0))
    engine = choice.choose(name, env, choice.ActingPolicy(policy.apply, actor, family), 20)

    def play(key):
        options = {"num_episodes": num_episodes, "horizon": 20}
        return engine.rollout(env, policy.apply, actor, family, key, **options)

    return engine, jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(1), seeds))


def test_the_device_code_plays_as_c_does():
    env = Sled()
    engine, episodes = _episodes("auto", env)
    assert engine.name == "native"
    assert "C++ compiler" in engine.why
    _, expected = _episodes("mujoco", env)
    assert episodes.observation.shape == expected.observation.shape
    np.testing.assert_array_equal(episodes.mask, expected.mask)
    np.testing.assert_allclose(episodes.action, expected.action, atol=2e-3)
    np.testing.assert_allclose(episodes.observation, expected.observation, atol=2e-3)
    np.testing.assert_allclose(episodes.reward, expected.reward, atol=2e-3)
    assert episodes.terms.keys() == expected.terms.keys()


def test_an_episode_depends_on_nothing_else():
    env = Sled()
    _, episodes = _episodes("auto", env)
    _, more = _episodes("auto", env, num_episodes=9)
    np.testing.assert_array_equal(more.observation[:, :, :5], episodes.observation)


def test_without_a_compiler_c_plays(monkeypatch):
    monkeypatch.setattr(cxx, "compiler", lambda: None)
    assert _episodes("auto", Sled())[0].name == "mujoco"
