"""What follows from the last forward pass of a step that C MuJoCo has made, beside C's own."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine.physics.mjx_internals import Simulation, with_fields
from mjx_reinforce.engine.team import last_pass
from mjx_reinforce.envs import models

ROBOT = """
<mujoco>
  <option timestep=".004" {option}>{flags}</option>
  <worldbody>
    <camera name="eye" pos="1 0 1"/>
    <geom type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .3" euler="5 10 20">
      <freejoint/>
      <geom size=".1"/>
      <site name="imu" pos=".05 .02 .01" euler="10 20 30"/>
      <body name="leg" pos=".1 0 0">
        <joint name="hip" type="ball" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .1 0 -.1" size=".03"/>
        <body name="shank" pos=".1 0 -.1">
          <joint name="knee" axis="0 1 0" stiffness="3"/>
          <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".03"/>
          <site name="foot" type="{zone}" pos="0 0 -.15" size=".2"/>
        </body>
      </body>
    </body>
    <body name="weight" pos="0 .4 .3"><freejoint/><geom name="weight" size=".05"/></body>
  </worldbody>
  <tendon>
    <spatial name="t" stiffness="50" springlength=".1">
      <site site="imu"/><site site="foot"/>
    </spatial>
  </tendon>
  <actuator><position name="m" joint="knee" kp="20"/></actuator>
  <equality><connect body1="weight" body2="trunk" anchor=".05 0 0"/></equality>
  <sensor>
    <gyro site="imu"/><accelerometer site="imu"/><velocimeter site="imu"/>
    <force site="foot"/><torque site="foot"/><touch name="push" site="foot"/>
    <touch site="foot" cutoff="1"/>
    <framepos objtype="site" objname="foot" reftype="body" refname="trunk"/>
    <framequat objtype="body" objname="leg"/><framexaxis objtype="geom" objname="weight"/>
    <framelinvel objtype="site" objname="foot"/><framelinacc objtype="site" objname="foot"/>
    <frameangvel objtype="body" objname="leg" reftype="body" refname="trunk"/>
    <frameangacc objtype="body" objname="leg"/><framelinvel objtype="xbody" objname="leg"/>
    <jointpos joint="knee"/><jointvel joint="knee"/><ballquat joint="hip"/><ballangvel joint="hip"/>
    <actuatorpos actuator="m"/><actuatorvel actuator="m"/><actuatorfrc actuator="m"/>
    <jointactuatorfrc joint="knee"/><tendonpos tendon="t"/><tendonvel tendon="t"/>
    <subtreecom body="trunk"/><subtreelinvel body="trunk"/><subtreeangmom body="trunk"/>
    {more}
  </sensor>
</mujoco>"""
FIELDS = ("xquat", "xmat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "xaxis", "xanchor")
FIELDS += ("cam_xpos", "subtree_com", "ten_length", "actuator_length", "actuator_force")
PARTS = {"option": "", "flags": "", "zone": "sphere", "more": ""}


@pytest.mark.slow
@pytest.mark.parametrize("option", ["", 'integrator="implicitfast"'])
def test_fields_and_sensors_are_those_of_c(option):
    model = mujoco.MjModel.from_xml_string(ROBOT.format_map(PARTS | {"option": option}))
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    pushes = []
    with jax.enable_x64(True):
        in_mjx = mjx.put_model(model, impl="jax")
        start = models.make_data(model)

        @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
        def shown(fields, cfrc_ext, touch):
            known = with_fields(start.replace(**fields), cfrc_ext=cfrc_ext)
            complete = last_pass.completed_data(model, in_mjx, known, touch)
            completed = last_pass.Completed(model, known, lambda: complete)
            return {name: getattr(completed, name) for name in (*FIELDS, "sensordata")}

        for steps in (1, 30, 20, 20):
            mujoco.mj_step(model, data, steps - 1)
            fields = {name: getattr(data, name).copy() for name in ("qpos", "qvel", "ctrl")}
            mujoco.mj_step(model, data)
            mujoco.mj_rnePostConstraint(model, data)
            push = data.sensor("push").data[0]  # the other one has a cutoff
            pushes.append(push)
            fields = jax.tree.map(jnp.asarray, fields | {"qacc": data.qacc})
            ours = shown(fields, jnp.asarray(data.cfrc_ext), jnp.asarray([push, push]))
            for name, x in ours.items():
                want = np.reshape(getattr(data, name), x.shape)
                np.testing.assert_allclose(x, want, rtol=1e-9, atol=1e-9, err_msg=name)
    assert max(pushes) > 1


@pytest.mark.parametrize(
    "part",
    [
        {"option": 'integrator="RK4"'},
        {"flags": '<flag sensor="disable"/>'},
        {"zone": "capsule"},
        {"more": "<clock/>"},
        {"more": '<contact geom1="weight" data="found"/>'},
    ],
)
def test_sensors_that_do_not_follow_are_not_made_up(part):
    model = mujoco.MjModel.from_xml_string(ROBOT.format_map(PARTS | part))
    known = models.make_data(mujoco.MjModel.from_xml_string("<mujoco/>"))
    completed = last_pass.Completed(model, known, lambda: known.replace(sensordata=None))
    assert completed.sensordata is known.sensordata


def test_a_field_that_nobody_has_is_named():
    model = mujoco.MjModel.from_xml_string(ROBOT.format_map(PARTS))
    with pytest.raises(AttributeError, match="no field 'xposs'"):
        _ = Simulation(last_pass.Completed(model, models.make_data(model), dict)).xposs
