"""Fields that an episode draws, in the device code, beside C MuJoCo with the same fields."""

import copy
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from experiments.kit import device_code
from mjx_reinforce.engine.team import tables
from mjx_reinforce.engine.team.tables import draws
from mjx_reinforce.envs import derived, models

_C: Any = mujoco
needs_compiler = pytest.mark.skipif(device_code.COMPILER is None, reason="there is no C++ compiler")
#: Something for each field to show in: contacts of each mix, rows of each kind, springs of balls
#: and free joints, bodies that share a link, gravity compensation, a medium.
_WALKER = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep=".004" {option}/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".8 .02 .003"/>
    <body name="base" pos="0 0 .255" simple="false">
      <joint name="root" type="free" stiffness=".4" damping=".1"/>
      <geom type="box" size=".15 .1 .05" mass="3" condim="6"/>
      <body pos=".1 0 .08"><geom size=".05" mass=".6"/></body>
      <body name="arm" pos="0 .15 .1" simple="false">
        <joint name="shoulder" type="ball" stiffness=".3" damping=".05" range="0 .3"/>
        <geom type="capsule" fromto="0 0 0 .1 .1 .1" size=".02" mass=".3" contype="0"/>
      </body>
      <body name="left" pos="-.1 0 -.05" gravcomp=".4">
        <joint name="hip" axis="0 1 0" range="-20 4" damping=".2" armature=".01"
          frictionloss=".3"/>
        <geom type="capsule" fromto="0 0 0 .03 0 -.18" size=".03" mass=".4" friction=".4 .01 .001"
          priority="1" condim="4"/>
        <body pos=".03 .01 -.1"><geom size=".04" mass=".2" contype="0" conaffinity="0"/></body>
      </body>
      <body name="right" pos=".1 0 -.05" gravcomp=".2">
        <joint name="slide" type="slide" axis="0 .1 1" stiffness="60" range="-.02 .02"/>
        <joint name="knee" axis="0 1 0" stiffness="2" damping=".1"/>
        <geom name="foot" type="capsule" fromto="0 0 0 0 0 -.16" size=".03" mass=".4"/>
        <site name="toe" pos="0 0 -.16"/><body pos="0 0 -.1"/>
      </body>
      <body pos=".4 0 -.18">
        <joint type="slide" axis="0 0 1" stiffness="9"/><geom name="ball" size=".08" mass=".5"/>
      </body>
    </body>
    {lone}
    <site name="post" pos=".3 .1 .3"/>
    <body mocap="true" pos="-.12 0 .02" euler="0 20 0"><geom size=".06"/></body>
    <body mocap="true" pos="0 2 0"><geom size=".1" friction=".3"/></body>
  </worldbody>
  <contact><pair geom1="floor" geom2="ball" friction=".9 .7 .02 .01 .01" condim="4"/></contact>
  <tendon>
    <fixed name="fixed" range="-.02 .02" frictionloss=".1">
      <joint joint="hip" coef=".7"/><joint joint="knee" coef="-.5"/>
    </fixed>
    <spatial stiffness="3" range="0 .3"><site site="post"/><site site="toe"/></spatial>
  </tendon>
  <equality>
    <joint joint1="slide" joint2="knee" polycoef="0 .1"/>
    <connect body1="arm" body2="base" anchor=".1 .1 .1" solref=".1 1"/>
    <weld body1="arm" body2="base" relpose=".1 .1 .1 1 .1 0 0" solref=".2 1"/>
  </equality>
  <actuator>
    <position joint="hip" kp="5" kv=".2" gear="1.5"/>
    <general joint="knee" gaintype="affine" gainprm="3 .1 .2" biastype="affine"
      biasprm=".1 -2 -.1"/>
    <motor tendon="fixed" gear="2"/>
    <motor joint="knee" gear="3"/>
  </actuator>
</mujoco>"""
_OPTIONS = {
    "pyramids in a medium": 'density="800" viscosity=".6" impratio="2"',
    "elliptic cones": 'cone="elliptic" impratio="10"',
    "implicitfast": 'integrator="implicitfast"',
    "few steps": 'iterations="4" ls_iterations="8"',
    "few steps, no islands": 'iterations="3"',
}
#: A newcomer's tests compile one of them.
_MARKED = [
    pytest.param(x, marks=[] if x == "elliptic cones" else pytest.mark.slow) for x in _OPTIONS
]
_LONE = '<body pos="-.5 0 .09"><freejoint/><geom type="box" size=".05 .07 .1" mass=".5"/></body>'


def _walker(options):
    stops_early = options.startswith("few steps")
    lone = "" if stops_early else _LONE
    m = _C.MjModel.from_xml_string(_WALKER.format(option=_OPTIONS[options], lone=lone))
    if options == "few steps, no islands":
        m.opt.disableflags |= _C.mjtDisableBit.mjDSBL_ISLAND
    if not stops_early:
        m.opt.tolerance, m.opt.ls_tolerance, m.opt.ls_iterations = 0, 1e-14, 100
    return m


def _drawn(m, names, seed):
    """Returns fields of a model with other numbers, where they are not zero."""
    rng = np.random.default_rng(seed)
    own = {name: np.array(getattr(m, name)) for name in names}
    fields = {name: x * rng.uniform(0.6, 1.6, x.shape) for name, x in own.items()}
    if "body_ipos" in names:
        may_move = (m.body_simple == 0)[:, None]
        fields["body_ipos"] = own["body_ipos"] + 0.02 * may_move * rng.normal(size=(m.nbody, 3))
    for name in {"body_mass", "dof_damping", "dof_armature"}.intersection(names):
        fields[name][1:] += 0.1  # also where the model has none
    return fields


def _numbers(m, names, fields):
    """Returns what the device code reads of these fields, and of what follows from them."""
    with jax.enable_x64(True):
        episode = {name: jax.numpy.asarray(x) for name, x in fields.items()}
        constants = derived.constants(m, episode)
        return np.array(tables.drawn_numbers(m, names, episode | constants))


def _in_c(m, fields):
    """Returns a model with other fields, and what C MuJoCo derives from them."""
    changed = copy.copy(m)
    for name, x in fields.items():
        getattr(changed, name)[:] = x
    _C.mj_setConst(changed, _C.MjData(changed))
    return changed


def _error(m, play, fields, numbers):
    """Returns the largest error of 20 steps, relative where above 1, and how many contacts were."""
    changed = _in_c(m, fields)
    data, last = _C.MjData(changed), {}
    rng = np.random.default_rng(0)
    data.qvel[:] = 0.5 * rng.normal(size=m.nv)
    mine = {name: getattr(data, name).copy() for name in device_code.STATE}
    touched = 0
    for _ in range(20):
        data.ctrl[:] = rng.uniform(-1, 1, m.nu)
        last = play(mine, data.ctrl, 1, numbers)
        _C.mj_step(changed, data)
        touched += data.ncon
    _C.mj_rnePostConstraint(changed, data)
    names = ("xipos", "cinert", "cvel", "cfrc_ext", "qfrc_actuator")
    pairs = [(x, getattr(data, name)) for name, x in mine.items()]
    pairs += [(last[name], getattr(data, name).ravel()) for name in names]
    errors = [np.abs(x - y).max() / max(1, np.abs(y).max()) for x, y in pairs]
    return max(errors), touched


@pytest.mark.slow
@pytest.mark.parametrize("options", _OPTIONS)
def test_numbers_of_the_model_itself_are_those_of_its_tables(options):
    m = _walker(options)
    own = {name: np.array(getattr(m, name)) for name in models.RANDOM}
    layout = draws.Layout(tables.of_model(m, tables.NUM_NEAR, models.RANDOM))
    expected = np.array(layout.base)[layout.places]
    assert len({*layout.places}) == len(layout.places) > 100
    np.testing.assert_allclose(_numbers(m, models.RANDOM, own), expected, rtol=1e-9, atol=1e-12)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", models.RANDOM)
def test_each_field_is_as_in_c(name, tmp_path):
    m = _walker("pyramids in a medium")
    play = device_code.compiled(m, tmp_path, random=(name,))
    fields = _drawn(m, (name,), 1)
    error, touched = _error(m, play, fields, _numbers(m, (name,), fields))
    assert error < 1e-9
    assert touched > 10
    own = {name: np.array(getattr(m, name))}
    assert _error(m, play, fields, _numbers(m, (name,), own))[0] > 1e-6  # the field does matter


@needs_compiler
@pytest.mark.slow
def test_a_search_that_stops_early_solves_for_no_damping_that_is_not_drawn(tmp_path):
    m = _walker("few steps")
    play = device_code.compiled(m, tmp_path, random=("dof_damping",))
    for scale in (0, 1):
        fields = {"dof_damping": scale * m.dof_damping}
        error, touched = _error(m, play, fields, _numbers(m, ("dof_damping",), fields))
        assert error < 1e-9
        assert touched > 10


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize("options", _MARKED)
def test_episodes_that_draw_all_fields_share_a_program(options, lanes, tmp_path):
    m = _walker(options)
    play = device_code.compiled(m, tmp_path, num_near=1, lanes=lanes, random=models.RANDOM)
    for seed in (1, 2, 1):
        fields = _drawn(m, models.RANDOM, seed)
        error, touched = _error(m, play, fields, _numbers(m, models.RANDOM, fields))
        assert error < 1e-9
        assert touched > 10
