"""Models with numbers that are not finite are refused by name; a limit may be infinite."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjx_reinforce.envs.models import load_model

ASSETS = Path(__file__).parents[2] / "envs" / "assets"

MODEL = """
<mujoco>
  <size nuser_geom="1"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" {joint}/>
      <geom name="ball" size="0.1" {geom}/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" {motor}/></actuator>
  <keyframe><key name="home" {key}/></keyframe>
</mujoco>
"""


def load(spoil=lambda model: None, **attributes):
    words = {"joint": "", "geom": "", "motor": "", "key": ""} | attributes
    model = mujoco.MjModel.from_xml_string(MODEL.format(**words))
    spoil(model)
    return load_model(model)


def spoil_gravity(model):
    model.opt.gravity[2] = np.nan


def spoil_place(model):
    model.geom_pos[0, 1] = -np.inf


CASES = [
    ({"spoil": spoil_gravity}, "in opt.gravity, as"),
    ({"spoil": spoil_place}, "in geom_pos of ball, as"),
    ({"key": 'qpos="nan"'}, "in key_qpos of home, as"),
    ({"key": 'ctrl="inf"'}, "in key_ctrl of home, as"),
    ({"motor": 'ctrlrange="nan 1"'}, "in actuator_ctrlrange of motor, as"),
    # Not what MuJoCo computes of it, such as actuator_length0.
    ({"motor": 'gear="nan"'}, "in actuator_gear of motor, as"),
    ({"geom": 'friction="nan 0 0"'}, "in geom_friction of ball, as"),
    ({"geom": 'mass="inf"'}, "in body_inertia of arm, body_mass of arm, as"),
    ({"joint": 'damping="nan"'}, "in dof_damping of hinge, as"),
    ({"joint": 'springref="inf"'}, "in qpos_spring of hinge, as"),
    ({"joint": 'range="nan 1"'}, "in jnt_range of hinge, as"),
    # The inertia of a finite number that is too large.
    ({"motor": 'gear="1e300"'}, "in actuator_acc0 of motor, as"),
]


@pytest.mark.parametrize(("attributes", "words"), CASES)
def test_the_field_and_its_element_are_named(attributes, words):
    message = f"the model has numbers that are not finite, {words} mjModel names them"
    with pytest.raises(ValueError, match=re.escape(message)):
        load(**attributes)


LEGAL = [
    {"motor": 'ctrlrange="-1 inf"'},
    {"motor": 'forcerange="-inf inf"'},
    {"joint": 'range="-1 inf"'},
    {"geom": 'user="nan"'},
    {"geom": 'rgba="nan 1 1 1"'},
]


@pytest.mark.parametrize("attributes", LEGAL)
def test_no_limit_and_what_no_step_reads_are_legal(attributes):
    assert load(**attributes).nu == 1


@pytest.mark.parametrize("path", sorted(ASSETS.glob("*.xml")), ids=lambda path: path.stem)
def test_the_models_of_the_package_have_finite_numbers(path):
    assert load_model(path.name).nu
