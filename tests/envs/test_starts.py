"""Where an episode starts, and what an action applies: in every engine as in C MuJoCo."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco as mujoco_bindings
import numpy as np
import pytest

from mjx_reinforce import Box, make_vec, reinforce, train_step
from mjx_reinforce.engine import base
from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco

#: MuJoCo's own names; it is a C extension without stubs.
mujoco: Any = mujoco_bindings
#: A finger with a servo and an actuator that has a state, held by a spring to what a mocap body
#: carries.
MODEL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"><body name="palm" pos="0 .02 0"/></body>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
        <site name="tip" pos=".3 0 0"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="palm" body2="lower" anchor=".6 0 0" solref=".3 1"/></equality>
  <actuator>
    <position name="servo" joint="shoulder" kp="5" ctrlrange="-2 2"/>
    <general name="muscle" joint="elbow" dyntype="filter" dynprm=".2" gainprm="2"/>
  </actuator>
  <keyframe>
    <key name="open" qpos=".2 -.1" qvel="0 .3" act=".4" ctrl=".2 -.3" mpos=".5 .1 .9"
      mquat="0.8 0 0.6 0"/>
    <key name="closed" qpos="-.2 .1"/>
  </keyframe>
</mujoco>
"""
#: What the second key frame leaves to the model.
FIELDS = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")


class Finger(MujocoEnv):
    """Starts where it is told; the observation has all that a start may have."""

    carried = ("ctrl",)

    def __init__(self, start, model=MODEL):
        super().__init__(
            xml_file=mujoco.MjSpec.from_string(model),
            frame_skip=3,
            max_episode_steps=20,
            reward_threshold=None,
        )
        self.start = start

    def initial(self, rng):
        return self.start(self, rng) if callable(self.start) else self.start

    def outcome(self, before, data, action):
        reward = before.ctrl[0] + before.mocap_pos[0, 0] + data.act[0]
        return reward, False, {"tip": data.site("tip").xpos[2]}

    def observe(self, data):
        hand = data.body("hand")
        fields = [data.qpos, data.qvel, data.act, data.ctrl, data.qacc, hand.xpos, hand.xquat]
        return jnp.concatenate([*fields, data.body("palm").xpos])


def from_open(env, rng):
    """Starts near the first key frame."""
    start = env.key_frame("open")
    return start | {"qpos": start["qpos"] + 0.1 * jax.random.normal(rng, (2,))}


STARTS = {
    "a key frame": "open",
    "a key frame with noise": from_open,
    "its controls alone": {"ctrl": np.array([0.3, 0.1])},
    "a mocap pose alone": {"mocap_pos": np.array([[0.4, 0.0, 1.1]])},
    "nothing": {},
}


@pytest.fixture
def float64():
    """Has JAX compute in float64, as C MuJoCo does."""
    with jax.enable_x64(True):
        yield


class SteppedByC:
    """One episode of a ``Finger`` by C MuJoCo alone."""

    def __init__(self, env, start):
        """Begins at fields of mjData by their names."""
        self.env = env
        self.data = mujoco.MjData(env.mj_model)
        for name, value in start.items():
            getattr(self.data, name)[:] = value
        mujoco.mj_forward(env.mj_model, self.data)

    def step(self, control):
        """Returns the observation, and the reward."""
        reward = self.data.ctrl[0] + self.data.mocap_pos[0, 0]
        self.data.ctrl[:] = control
        mujoco.mj_step(self.env.mj_model, self.data, self.env.frame_skip)
        return self.observe(), reward + self.data.act[0]

    def observe(self):
        data = self.data
        fields = [data.qpos, data.qvel, data.act, data.ctrl, data.qacc]
        hand = data.body("hand")
        return np.concatenate([*fields, hand.xpos, hand.xquat, data.body("palm").xpos])


def compare_with_c(env, task, key, tolerance):
    """Plays ten env steps of a task, in an engine and in C MuJoCo alone."""
    _, start = env.draw(key)
    alone = SteppedByC(env, start)
    keys = key[None]
    state = jax.jit(jax.vmap(task.reset))(keys)
    step = jax.jit(jax.vmap(task.step))
    np.testing.assert_allclose(state.obs[0], alone.observe(), atol=tolerance)
    for action in np.random.default_rng(0).uniform(-1, 1, (10, env.action_size)):
        state = step(state, jnp.asarray(action)[None])
        observation, reward = alone.step(np.asarray(env.control(action)))
        np.testing.assert_allclose(state.obs[0], observation, atol=tolerance)
        np.testing.assert_allclose(state.reward[0], reward, atol=tolerance)


@pytest.mark.parametrize("name", STARTS)
@pytest.mark.parametrize("engine", [pytest.param("vmap", marks=pytest.mark.slow), "mujoco"])
def test_episodes_from_all_starts_are_cs(float64, engine, name):
    env = Finger(STARTS[name])
    task = env if engine == "vmap" else env.in_c_mujoco()
    # MJX's solver stops where C's does, but for rounding; C's own bits are kept in C.
    compare_with_c(env, task, jax.random.key(1), 1e-8 if engine == "vmap" else 0)


@pytest.mark.parametrize("name", STARTS)
def test_one_episode_in_c_starts_there_too(float64, name):
    env = Finger(STARTS[name])
    key = jax.random.key(1)
    peer = InMujoco(env)
    alone = SteppedByC(env, env.draw(key)[1])
    np.testing.assert_array_equal(peer.reset(key), alone.observe())
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 2)):
        observation, reward, _ = peer.step(action)
        expected_observation, expected_reward = alone.step(action)
        np.testing.assert_array_equal(observation, expected_observation)
        assert reward == pytest.approx(expected_reward, abs=1e-12)


@pytest.mark.slow
def test_machine_code_starts_there_too(float64):
    env = Finger(from_open)
    keys = jax.random.split(jax.random.key(2), 4)
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 4, 2))
    observations = {}
    for engine in ("vmap", "native", "mujoco"):
        vec = make_vec(env, 4, engine=engine)
        state = vec.reset(keys)
        rows = [state.obs]
        for action in actions:
            state = vec.step(state, action)
            rows.append(state.obs)
        observations[engine] = np.stack(rows)
    for engine in ("native", "mujoco"):
        np.testing.assert_allclose(observations[engine], observations["vmap"], atol=1e-7)


@pytest.mark.slow
def test_set_state_takes_the_same_fields(float64):
    env = Finger("closed")
    qpos, qvel = jnp.array([0.1, 0.2]), jnp.zeros(2)
    others = {"act": jnp.array([0.7]), "mocap_pos": jnp.array([[0.3, 0.2, 0.8]])}
    expected = SteppedByC(env, {"qpos": qpos, "qvel": qvel, **others}).observe()
    for task in (env, env.in_c_mujoco()):
        state = task.set_state(qpos, qvel, **others)
        np.testing.assert_allclose(state.obs, expected, atol=1e-10)
        # What was set before is not there in the next episode.
        plain = SteppedByC(env, {"qpos": qpos, "qvel": qvel}).observe()
        np.testing.assert_allclose(task.set_state(qpos, qvel).obs, plain, atol=1e-10)
    with pytest.raises(ValueError, match="unknown field of a start 'mocap_pose'"):
        env.set_state(qpos, qvel, mocap_pose=qpos)
    with pytest.raises(ValueError, match=r"ctrl must be \[2\], got the shape \[3\]"):
        env.set_state(qpos, qvel, ctrl=jnp.zeros(3))


def test_a_key_frame_is_all_of_it():
    env = Finger("open")
    data = mujoco.MjData(env.mj_model)
    mujoco.mj_resetDataKeyframe(env.mj_model, data, 0)
    start = env.key_frame("open")
    assert set(start) == set(FIELDS)
    for name in FIELDS:
        np.testing.assert_allclose(start[name], getattr(data, name), atol=1e-7)
        np.testing.assert_array_equal(env.key_frame(0)[name], start[name])


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ("shut", "no key frame 'shut'; it has: 'open', 'closed'"),
        ({"position": np.zeros(2)}, "cannot start with 'position'; it can with qpos, qvel, act"),
        ({"act": np.zeros(2)}, r"must return act \[1\], .* got the shape \[2\]"),
        ({"mocap_pos": np.zeros(3)}, r"must return mocap_pos \[1, 3\], .* got the shape \[3\]"),
        (3, "a dict of fields of mjData, or the name of a key frame, got"),
    ],
)
def test_a_wrong_start_is_named(start, message):
    with pytest.raises(ValueError, match=message):
        Finger(start).reset(jax.random.key(0))


# -------------------------------------------------------------------------------------------------
# Actions around a pose.

SCALE = np.array([0.5, 0.25])


class Servo(Finger):
    """One number moves both actuators, around the controls of the key frame."""

    def __init__(self, start="open"):
        super().__init__(start)
        self.home = self.mj_model.key("open").ctrl
        self.action_space = Box(-np.ones(1), np.ones(1))

    def control(self, action):
        return self.home + SCALE * action


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["vmap", "mujoco"])
def test_an_action_applies_its_control(float64, engine):
    env = Servo()
    task = env if engine == "vmap" else env.in_c_mujoco()
    assert (env.action_size, task.action_size) == (1, 1)
    compare_with_c(env, task, jax.random.key(3), 1e-8 if engine == "vmap" else 0)
    peer = InMujoco(env)
    peer.reset(jax.random.key(3))
    peer.step(np.array([0.5]))
    np.testing.assert_array_equal(peer.data.ctrl, env.home + SCALE * 0.5)


@pytest.mark.slow
def test_the_physics_kept_whole_gets_the_control():
    """As a team of a GPU's lanes has it: its first operand is ctrl."""
    env = Servo()
    with base.keeping_whole():
        state = jax.eval_shape(env.reset, jax.random.key(0))
        program = jax.make_jaxpr(env.step)(state, jnp.zeros(1))
    (physics,) = [x for x in program.eqns if x.params.get("name") == "physics"]
    assert physics.invars[0].aval.shape == (2,)
    assert jax.eval_shape(env.step, state, jnp.zeros(1)).obs.shape == state.obs.shape


@pytest.mark.slow
def test_a_policy_around_a_pose_trains_alike_in_every_engine():
    returns = {}
    for engine in ("vmap", "native", "mujoco"):
        learner = reinforce(Servo(), num_episodes=4, horizon=10, engine=engine)
        state = learner.init(jax.random.key(0))
        _, metrics = train_step(learner, state)
        returns[engine] = float(metrics["episode_return"])
    assert returns["native"] == pytest.approx(returns["vmap"], rel=1e-3)
    assert returns["mujoco"] == pytest.approx(returns["vmap"], rel=1e-3)


class Mistaken(Servo):
    """Gives one control to two actuators."""

    def control(self, action):
        return action


@pytest.mark.slow
def test_another_number_of_controls_is_named():
    message = r"Mistaken.control must return \[2\], .* got the shape \[1\]; an action is \[1\]"
    env = Mistaken()
    state: Any = env.reset(jax.random.key(0))
    for task in (env, env.in_c_mujoco()):
        with pytest.raises(BadEnvironmentError, match=message):
            jax.eval_shape(task.step, task.reset(jax.random.key(0)), jnp.zeros(1))
    assert state.obs.shape == (env.observation_size,)


# -------------------------------------------------------------------------------------------------
# Models that a program makes or changes.


class Rod(MujocoEnv):
    """A model of one joint, upright."""

    def __init__(self, spec):
        super().__init__(xml_file=spec, frame_skip=5, max_episode_steps=20, reward_threshold=None)

    def initial(self, rng):
        return {}

    def outcome(self, before, data, action):
        return -(data.qpos[0] ** 2), False, {}


def rod():
    """Returns a pendulum with a motor, made in Python."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="rod")
    body.add_joint(name="hinge", axis=[0, 1, 0], damping=0.1)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.02, 0, 0], fromto=[0, 0, 0, 0, 0, 1])
    actuator = spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_motor()
    return spec


@pytest.mark.parametrize("engine", [pytest.param("vmap", marks=pytest.mark.slow), "mujoco"])
def test_specs_play(engine):
    """The motor pushes the rod over; where it became a servo, the rod goes where it is told."""
    changed = rod()
    for actuator in changed.actuators:
        actuator.set_to_position(kp=200, dampratio=1)
    angles = []
    for spec in (rod(), changed):
        env = Rod(spec)
        task = env if engine == "vmap" else env.in_c_mujoco()
        state = task.reset(jax.random.key(0))
        assert state.obs.tolist() == [0, 0]
        step = jax.jit(task.step)
        for _ in range(200):
            state = step(state, jnp.full(1, 0.3))
        angles.append(float(state.obs[0]))
    assert angles[0] > 1
    assert angles[1] == pytest.approx(0.3, abs=0.05)
