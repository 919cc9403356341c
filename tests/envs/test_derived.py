"""Models that an episode draws, beside C MuJoCo with the same model compiled anew."""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco as mujoco_bindings
import numpy as np
import pytest

from mjx_reinforce import envs, make_vec
from mjx_reinforce.engine.base import shapes
from mjx_reinforce.envs import derived, dynamics, models
from mjx_reinforce.envs.base import MujocoEnv

#: MuJoCo's own names; it is a C extension without stubs.
mujoco: Any = mujoco_bindings
#: Something for every constant to be read by: contacts, limits, friction losses, equalities and
#: tendons of each kind, muscles, a sensor of a subtree, and a camera that follows it.
SOURCE = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.004"/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <body name="base" pos="0 0 .2" simple="false">
      <freejoint/>
      <geom type="sphere" size=".1" mass="2"/>
      <site name="hip" pos=".1 .05 0"/>
      <camera name="near" mode="trackcom" pos="0 -1 .3"/>
      <body pos=".1 0 0">
        <joint name="hip" axis="0 1 0" range="-.05 .05" damping=".1" frictionloss=".05"
          armature=".01"/>
        <geom type="capsule" fromto="0 0 0 .05 0 -.1" size=".02" mass=".4" contype="0"
          conaffinity="0"/>
        <site name="knee" pos=".03 .02 -.05"/>
        <body name="shank" pos=".05 0 -.1">
          <joint name="knee" axis="0 1 0" stiffness=".5"/>
          <geom type="sphere" pos="0 0 -.08" size=".03" mass=".1"/>
          <site name="toe" pos="0 .02 -.08"/>
        </body>
      </body>
      <body name="arm" pos="-.1 0 .05">
        <joint name="shoulder" type="ball" range="0 .1" damping=".05"/>
        <inertial pos="-.1 .01 .05" quat=".9 .1 .2 .3" mass=".3" diaginertia=".003 .002 .0015"/>
      </body>
    </body>
    <body name="slider" pos="-.3 0 .4" simple="{simple}">
      <joint name="slide" type="slide" axis="1 0 0" armature=".1" frictionloss=".1"/>
      <geom size=".1" mass=".5" contype="0" conaffinity="0"/>
    </body>
    <body name="post" pos="0 1 0"><geom size=".1" mass="5"/></body>
    <body name="hand" mocap="true" pos=".02 0 .19"/>
  </worldbody>
  <tendon>
    <fixed name="fixed" range="-.02 .02" frictionloss=".02" armature=".003">
      <joint joint="hip" coef=".7"/><joint joint="knee" coef="-.5"/>
    </fixed>
    <spatial name="pull" stiffness="3" armature=".05">
      <site site="hip"/><site site="knee"/><site site="toe"/>
    </spatial>
  </tendon>
  <equality>
    <joint joint1="slide" joint2="knee" polycoef="0 .1"/>
    <connect body1="arm" body2="slider" anchor="-.2 0 .1" solref=".1 1"/>
    <weld body1="base" body2="hand" solref=".2 1"/>
    <tendon tendon1="fixed" tendon2="pull" polycoef="0 .2"/>
  </equality>
  <actuator>
    <position joint="hip" kp="5" dampratio=".7"/>
    <muscle tendon="pull" ctrlrange="0 1" lengthrange=".1 .3"/>
    <muscle joint="knee" ctrlrange="0 1" lengthrange="-1 1" gear=".3"/>
    <motor joint="shoulder" gear=".1 .2 .05"/>
  </actuator>
  <sensor><subtreelinvel body="base"/></sensor>
</mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(SOURCE.format(simple="false"))
#: What an episode draws: one field, or all of them.
DRAWN = [*models.RANDOM, "all"]


def drawn_fields(model, rng):
    """Returns each field of ``models.RANDOM`` with other numbers; those that are 0 may stay so."""
    fields = {}
    for key, name in zip(jax.random.split(rng, len(models.RANDOM)), models.RANDOM, strict=True):
        field = jnp.asarray(getattr(model, name))
        fields[name] = field * jax.random.uniform(key, field.shape, minval=0.6, maxval=1.8)
    centers = jnp.asarray(model.body_ipos)
    may_move = (model.body_simple == 0)[:, None]
    shift = 0.02 * jax.random.normal(rng, centers.shape)
    return fields | {"body_ipos": jnp.where(may_move, centers + shift, centers)}


def compiled(model, fields):
    """Returns a copy of a model with other fields, and what MuJoCo derives from them."""
    model = copy.copy(model)
    for name, field in fields.items():
        getattr(model, name)[:] = field
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


class Mechanism(MujocoEnv):
    """Draws one field of its model, or all."""

    def __init__(self):
        super().__init__(xml_file=MODEL, frame_skip=2, max_episode_steps=50, reward_threshold=None)

    def randomize(self, rng):
        choice_key, key = jax.random.split(rng)
        number = jax.random.randint(choice_key, (), 0, len(DRAWN))
        fields = drawn_fields(self.mj_model, key)
        return {"number": number} | {
            name: jnp.where((number == i) | (number == len(fields)), field, getattr(MODEL, name))
            for i, (name, field) in enumerate(fields.items())
        }

    def initial(self, rng):
        qpos = jnp.asarray(self.mj_model.qpos0)
        return qpos, jax.random.normal(rng, (self.mj_model.nv,))

    def outcome(self, before, data, action):
        return 0.0, False, {}

    def observe(self, data):
        rest = data.sensordata, data.camera("near").xpos
        return jnp.concatenate([data.qpos, data.qvel, *rest])


@pytest.fixture
def float64():
    """Has JAX compute in float64, as C MuJoCo does."""
    with jax.enable_x64(True):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("simple", ["auto", "false"])
@pytest.mark.parametrize("name", DRAWN)
def test_constants_are_those_that_mujoco_computes(float64, name, simple):
    """Where ``constants`` has nothing, or has what nothing reads, they are those of the model."""
    model = mujoco.MjModel.from_xml_string(SOURCE.format(simple=simple))
    fields = drawn_fields(model, jax.random.key(3))
    if name != "all":
        fields = {name: fields[name]}
    constants = derived.constants(model, fields)
    expected = compiled(model, fields)
    readers = {
        "body_subtreemass": slice(None),
        "body_invweight0": [model.body(x).id for x in ("base", "shank", "arm", "slider", "post")],
        "dof_invweight0": slice(None),
        "tendon_invweight0": slice(None),
        "actuator_acc0": [1, 2],
        "cam_poscom0": slice(None),
    }
    for constant, rows in readers.items():
        got = np.asarray(constants.get(constant, getattr(model, constant)))[rows]
        np.testing.assert_allclose(got, getattr(expected, constant)[rows], rtol=1e-12, atol=1e-13)
    reads_masses = name in ("body_mass", "all")
    assert ("body_subtreemass" in constants) == reads_masses
    assert bool(constants) == (name in (*derived.READ, "all"))


@pytest.mark.slow
def test_what_nothing_reads_is_not_derived():
    """Without rows, muscles, sensors and cameras the start of an episode is as short as before."""
    source = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body>
      </worldbody><actuator><motor joint="x"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(source)
    assert derived.constants(model, drawn_fields(model, jax.random.key(0))) == {}
    start = jax.eval_shape(envs.make("Hopper-v5").reset, jax.random.key(0))
    assert start.pipeline_state.constants == {}


@pytest.mark.slow
def test_asking_for_shapes_traces_no_physics(monkeypatch):
    """Although this model is no team's, and differs from episode to episode."""
    env = Mechanism()
    monkeypatch.setattr(dynamics, "_forward", lambda *_: pytest.fail("the physics is traced"))
    start = shapes(env.reset, jax.random.key(0))
    after = shapes(env.step, start, np.zeros(env.action_size, np.float32))
    assert start.obs.shape == after.obs.shape == (env.observation_size,)
    assert jax.tree.structure(start) == jax.tree.structure(after)
    assert jax.tree.leaves(start) == jax.tree.leaves(after)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["vmap", "native", "mujoco"])
def test_episodes_are_those_of_models_compiled_with_what_was_drawn(float64, engine):
    """Each draws another field; without the constants that follow, C ends elsewhere."""
    env, num_steps = Mechanism(), 15
    many = jax.random.split(jax.random.key(0), 200)
    # An episode begins with the second half of its key.
    episodes, _ = jax.jit(jax.vmap(lambda key: env.draw(jax.random.split(key)[1])))(many)
    _, first = np.unique(episodes["number"], return_index=True)
    keys = many[first]
    vec = make_vec(env, len(keys), engine=engine)
    state = vec.reset(keys)
    episodes = jax.device_get(state.simulation.pipeline_state.episode)
    assert episodes["number"].tolist() == list(range(len(DRAWN)))
    actions = np.random.default_rng(0).uniform(-1, 1, (num_steps, len(keys), env.action_size))
    observations = [np.asarray(state.obs)]
    for action in actions:
        state = vec.step(state, action)
        observations.append(np.asarray(state.obs))
    touching = 0
    for i, name in enumerate(DRAWN):
        fields = {field: episodes[field][i] for field in models.RANDOM}
        model = compiled(MODEL, fields)
        stale = copy.copy(model)
        for constant in ("body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0"):
            getattr(stale, constant)[:] = getattr(MODEL, constant)
        ends = []
        for one in (model, stale):
            data = mujoco.MjData(one)
            data.qpos[:] = observations[0][i][: one.nq]
            data.qvel[:] = observations[0][i][one.nq :][: one.nv]
            mujoco.mj_forward(one, data)
            for step in range(num_steps + 1):
                if one is model:
                    expected = [data.qpos, data.qvel, data.sensordata, data.cam_xpos[0]]
                    np.testing.assert_allclose(
                        observations[step][i], np.concatenate(expected), rtol=1e-9, atol=1e-9
                    )
                    touching += data.ncon
                if step < num_steps:
                    data.ctrl[:] = actions[step, i]
                    mujoco.mj_step(one, data, env.frame_skip)
            ends.append(np.array(data.qpos))
        differs = np.abs(ends[0] - ends[1]).max()
        assert (differs > 1e-7) == (name in (*derived.READ, "all")), (name, differs)
    assert touching > 0
