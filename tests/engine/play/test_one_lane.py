"""Robots that C MuJoCo plays best, by the device code with one lane on a CPU."""

import signal
import threading
import time
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_reinforce as mr
from mjx_reinforce.engine.cpu import emit
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


def _episodes(name, env, *, act=None, seeds=2, num_episodes=5):
    """Returns the engine of a name, and episodes [S, T, N] of seeds by it."""
    family = mr.normal(env.action_space)
    policy = mr.mlp_policy(env.observation_size, family, (8, 8))
    actor = policy.init(jax.random.key(0))
    act = act or policy.apply
    engine = choice.choose(name, env, choice.ActingPolicy(act, actor, family), 20)

    def play(key):
        options = {"num_episodes": num_episodes, "horizon": 20}
        return engine.rollout(env, act, actor, family, key, **options)

    return engine, jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(1), seeds))


def _own_act(actor, observation):
    """A network that is none of ours, of units that all units of the next layer read."""
    mix = jnp.sin(jnp.arange(15 * 16.0)).reshape(15, 16)
    units = jnp.tanh(observation @ mix)
    return 0.1 * jnp.tanh(units @ mix.T) @ mix[:, :2]


@pytest.mark.slow
@pytest.mark.parametrize("act", [None, _own_act])
def test_the_device_code_plays_as_c_does(act):
    env = Sled()
    engine, episodes = _episodes("auto", env, act=act)
    assert engine.name == "native"
    assert "C++ compiler" in engine.why
    _, expected = _episodes("mujoco", env, act=act)
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
    with pytest.raises(ValueError, match=r"install a C\+\+ compiler"):
        _episodes("native", Sled())


#: Programs that are called c++ and are none, or none that makes kernels.
_NO_COMPILERS = {
    "another machine's program": b"\x7fELF",
    "it fails, and writes no UTF-8": b"#!/bin/sh\nprintf '\\377' >&2; exit 1\n",
}


def _program(folder, content):
    """Writes a program that is called c++; returns where."""
    path = folder / "c++"
    path.write_bytes(content)
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize("name", _NO_COMPILERS)
def test_what_is_no_compiler_is_passed_over(name, monkeypatch, tmp_path):
    _program(tmp_path, _NO_COMPILERS[name])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert cxx.compiler.__wrapped__() is None


def test_what_the_compiler_refuses_c_plays(monkeypatch, tmp_path):
    # As a compiler that is too old: it takes its options, and not the text.
    path = _program(tmp_path, b"#!/bin/sh\necho 'k.cpp:1:1: error: what is this?' >&2; exit 1\n")
    monkeypatch.setattr(cxx, "compiler", lambda: path)
    monkeypatch.setattr(cxx, "version", lambda: "too old")
    with warnings.catch_warnings():
        # vmap does not play, so nothing is said of what it computes.
        warnings.filterwarnings("error", message="JAX .* computes")
        engine, _ = _episodes("auto", Sled())
    assert engine.name == "mujoco"
    assert engine.why.endswith("c++ refuses it: what is this?")


def test_a_compiler_ends_with_what_it_has_started(monkeypatch):
    processes = []
    monkeypatch.setattr(emit, "_PROCESSES", processes)
    monkeypatch.setattr(emit, "_EXIT_EVENT", threading.Event())
    # The child holds the pipes: unless it ends too, nobody would see their end for a minute.
    later = emit.later(lambda: emit.run(["sh", "-c", "sleep 60 & wait"]))
    while not processes:
        time.sleep(0.01)
    time.sleep(0.3)
    emit.end_processes(seconds=0)
    assert later.result(timeout=20).returncode == -signal.SIGKILL
