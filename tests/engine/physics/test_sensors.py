"""Sensors of forces and accelerations, and forces on bodies, against C MuJoCo.

``experiments/checks/matrix.py`` crosses every sensor with all that forces come through.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv

#: Two links, and a weight on a slide; what follows is added.
ARM = """
<mujoco>
  <option {option}>{flags}</option>
  <default><geom contype="0" conaffinity="0" density="800"/></default>
  <worldbody>
    <site name="wall" pos=".3 -.2 .2"/>
    <geom name="pin" type="sphere" size=".1" pos=".35 .1 .55"/>
    {world}
    <body name="upper" pos="0 0 1">
      <joint name="a" axis="0 1 .2"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      <site name="middle" pos=".2 0 .05" euler="10 20 30"/>
      <body name="lower" pos=".4 0 0">
        <joint name="b" axis="0 1 0"/>
        <geom name="lower" type="capsule" fromto="0 0 0 .3 0 0" size=".04" {lower}/>
        <site name="tip" pos=".3 .02 0" euler="40 0 10" size=".2"/>
      </body>
    </body>
    <body name="weight" pos=".5 .3 .8">
      <joint name="c" type="slide" axis="0 0 1"/>
      <geom size=".05"/>
      <site name="weight" pos=".01 0 .02"/>
    </body>
  </worldbody>
  <tendon>{tendon}</tendon>
  <actuator><motor joint="a" gear="2"/>{actuator}</actuator>
  <equality>{equality}</equality>
  <sensor>
    <force site="middle"/><torque site="middle"/><force site="tip"/><torque site="tip"/>
    <force site="weight"/><accelerometer site="tip"/>{sensor}
  </sensor>
</mujoco>
"""
STRAIGHT = '<site site="wall"/><site site="tip"/>'
BENT = '<site site="wall"/><geom geom="pin"/><site site="tip"/>'
SPLIT = '<site site="wall"/><site site="middle"/><pulley divisor="2"/>'
PULLED = '<motor tendon="t" gear="3"/>'
#: What pulls at a tendon of sites.
PULLS = {
    "actuator": ("", PULLED),
    "clamped actuators": ('actuatorfrcrange="-.5 .5"', PULLED + '<velocity tendon="t" kv="2"/>'),
    "spring and damper": ('stiffness="40" springlength=".2 .3" damping="2"', ""),
    "upper limit": ('range=".1 .4"', ""),
    "lower limit": ('range="2 3"', ""),
    "friction loss": ('frictionloss=".3"', ""),
    "armature": ('armature=".2"', ""),
}
CASES = {
    name: {"tendon": f'<spatial name="t" {way}>{STRAIGHT}</spatial>', "actuator": actuator}
    for name, (way, actuator) in PULLS.items()
}
#: Equalities, and contacts.
HELD = {
    "equality": '<connect body1="upper" body2="weight" anchor=".2 0 0"/>'
    '<weld body1="lower" body2="world"/>',
    "lower": 'contype="1"',
    "world": '<geom type="plane" size="5 5 1" conaffinity="1" pos="0 0 .98"/>',
    "sensor": '<touch site="tip"/>',
}
FLAGS = "equality", "contact", "constraint"
CASES |= {
    "over a sphere": {"tendon": f'<spatial name="t">{BENT}</spatial>', "actuator": PULLED},
    "pulley": {
        "tendon": f'<spatial name="t">{SPLIT}<site site="middle"/><site site="tip"/></spatial>',
        "actuator": PULLED,
    },
    "equality": {
        "tendon": f'<spatial name="t">{STRAIGHT}</spatial>'
        '<spatial name="u"><site site="middle"/><site site="weight"/></spatial>',
        "equality": '<tendon tendon1="t" tendon2="u" polycoef=".1 .7 .5 0 0"/>',
    },
    "Runge-Kutta": {"option": 'integrator="RK4"'},
    **{f"no {flag}": HELD | {"flags": f'<flag {flag}="disable"/>'} for flag in FLAGS},
    "no contacts": {
        "sensor": '<touch site="tip"/><contact geom1="lower" num="2" data="found force"/>'
    },
    "no actuation": {
        "actuator": '<motor name="m" joint="b"/>',
        "flags": '<flag actuation="disable"/>',
        "sensor": '<actuatorvel actuator="m"/><actuatorpos actuator="m"/>',
    },
    "cutoff": {"sensor": '<framelinacc objtype="site" objname="tip" cutoff=".5"/>'},
}


def start(model):
    """Returns positions and velocities."""
    return model.qpos0 + 0.1 * np.cos(np.arange(model.nq)), 0.3 * np.cos(1 + np.arange(model.nv))


def of(name):
    """Returns a model, and a simulation of it by C at the start."""
    places = "option", "flags", "world", "lower", "tendon", "actuator", "equality", "sensor"
    model = mujoco.MjModel.from_xml_string(ARM.format_map(dict.fromkeys(places, "") | CASES[name]))
    model.opt.tolerance, model.opt.ls_tolerance, model.opt.iterations = 0, 0, 200
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start(model)
    data.ctrl[:] = 1
    return model, data


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_sensors_show_what_those_of_c_show(name):
    model, data = of(name)
    with jax.enable_x64(True):
        in_mjx = mjx.put_model(model, impl="jax")
        given = {x: jnp.asarray(getattr(data, x)) for x in ("qpos", "qvel", "ctrl")}
        forward = functools.partial(physics.forward, in_mjx)

        @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
        def shown(given):
            begin = models.make_data(model).replace(**given)
            return physics.step(in_mjx, begin, forward).sensordata

        ours = shown(given)
    mujoco.mj_step(model, data)
    assert np.any(data.sensordata != 0)
    np.testing.assert_allclose(ours, data.sensordata, rtol=1e-9, atol=1e-9)


class Pulled(MujocoEnv):
    """It shows the forces on bodies."""

    contact_forces = True

    def initial(self, rng):
        return tuple(map(jnp.asarray, start(self.mj_model)))

    def observe(self, data):
        return jnp.concatenate([jnp.ravel(x[1:]) for x in (data.cfrc_ext, data.cfrc_int)])

    def outcome(self, before, data, action):
        return 0.0, False, {}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spring and damper", "armature"])
def test_contact_forces_are_those_of_c_after_a_step(name):
    model, data = of(name)
    settings = {"frame_skip": 2, "max_episode_steps": 9, "reward_threshold": None}
    with jax.enable_x64(True):
        env = Pulled(xml_file=model, **settings)
        ours = env.step(env.reset(jax.random.key(0)), jnp.ones(model.nu)).obs
    mujoco.mj_step(model, data, 2)
    mujoco.mj_rnePostConstraint(model, data)
    theirs = np.concatenate([data.cfrc_ext[1:].ravel(), data.cfrc_int[1:].ravel()])
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
