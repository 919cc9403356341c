"""Models of others are mended: the feet alone collide, and what MJX refuses is changed."""

import mujoco
import numpy as np
import pytest
from PIL import Image

from mjx_reinforce.envs import models, refusals
from mjx_reinforce.envs.mending import edits, ground, written

C = mujoco
read = mujoco.MjSpec.from_string  # pyright: ignore[reportAttributeAccessIssue]

LEG = """<body name="{name}" pos="{x} 0 0"><joint name="{name}" axis="0 1 0"/>
  <geom name="{name}_hip" type="cylinder" size=".05 .02" mass=".2" condim="1"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>
  <geom name="{name}_foot" pos="0 0 -.25" {foot}/></body>"""
BALL = 'size=".03" condim="3"'
#: A wedge whose axes of inertia are not those of the body.
SHOE = 'type="mesh" mesh="shoe"'
ROBOT = """<mujoco><option cone="elliptic"/><asset>
    <mesh name="shoe" vertex="-.1 -.05 -.02 .1 -.05 -.02 -.1 .05 -.02 .1 .05 -.02 -.1 0 .06"/>
  </asset>
  <default><geom margin=".001"/></default><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <geom name="wall" type="plane" size="1 1 1" pos="2 0 0" euler="0 -90 0"/>
  <body name="trunk" pos="0 0 .31"><freejoint/><geom type="box" size=".3 .1 .05"/>
  <geom name="nose" type="cylinder" pos=".3 0 0" size=".03 .03"/>{}{}</body></worldbody>
  <actuator><motor joint="front"/><motor joint="hind"/></actuator>
  <sensor><touch site="s"/></sensor></mujoco>"""


#: An arm in a folder of its own, whose shapes collide without a mass.
LIMB = """<mujoco><compiler meshdir="shapes" texturedir="looks"/>
  <default><default class="collision"><geom mass="0" density="0"/></default></default>
  <asset><mesh name="hand" file="hand.obj"/><hfield name="hills" file="hills.png" size="1 1 1 1"/>
    <texture name="grass" type="2d" file="grass.png"/></asset>
  <worldbody><geom type="hfield" hfield="hills"/>
    <body name="arm"><joint axis="0 1 0"/><geom size=".1" pos="1 0 0" mass="1"/>
    <geom class="collision" type="mesh" mesh="hand"/>
    <geom class="collision" size=".1" density="300"/></body></worldbody></mujoco>"""
ASSEMBLED = """<mujoco><asset><model name="arm" file="robots/arm/arm.xml"/></asset>
  <worldbody><attach model="arm" body="arm" prefix="left/"/>
  <frame pos="0 1 0"><attach model="arm" prefix="right/"/></frame></worldbody></mujoco>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def robot(foot):
    legs = (LEG.format(name=n, x=x, foot=foot) for n, x in (("front", 0.25), ("hind", -0.25)))
    return read(ROBOT.format(*legs).replace('<sensor><touch site="s"/></sensor>', ""))


def test_only_the_feet_collide():
    """With the floor and the wall; the robot is as heavy, and rests on them."""
    spec = robot(BALL)
    model = spec.compile()
    assert ground.contact_counts(model) == "25 possible contacts, 16 with the ground"
    assert "cylinder" in refusals.best_in_c(model)
    mended = edits.mend(spec)
    after = mended.spec.compile()
    assert mended.edits == [
        'cone="pyramidal" in place of elliptic',
        "only the feet collide (front_foot, hind_foot), possible contacts 4 in place of 25",
    ]
    assert refusals.best_in_c(after) is None
    names = {(after.geom(one).name, after.geom(two).name) for one, two, _ in ground.pairs(after)}
    assert names == {(x, f"{y}_foot") for x in ("floor", "wall") for y in ("front", "hind")}
    np.testing.assert_array_equal(after.body_inertia, model.body_inertia)
    data = C.MjData(after)
    C.mj_step(after, data, 50)
    assert {after.geom(int(x)).name for x in data.contact.geom.ravel()} == {
        *("floor", "front_foot", "hind_foot")
    }
    assert edits.mend(mended.spec).edits == []


def test_what_lies_on_its_trunk_has_no_feet():
    """As Gymnasium's ant, whose legs are level; its trunk goes on to collide."""
    spec = robot(BALL)
    for geom in spec.geoms:
        if geom.name.endswith("_foot"):
            geom.pos = [0.3, 0, 0]
        if geom.type == C.mjtGeom.mjGEOM_CAPSULE:
            geom.fromto = [0, 0, 0, 0.2, 0, 0]
    model = spec.compile()
    assert ground.stance(model) is None
    assert not any("feet" in edit for edit in edits.mend(spec).edits)


def test_possible_contacts_are_those_of_c():
    """Of a robot in a heap, C MuJoCo has contacts of just these pairs."""
    model = robot(BALL).compile()
    model.geom_pos[:] = 0
    model.body_pos[:] = 0
    model.geom_size[:] = 0.1
    data = C.MjData(model)
    data.qpos[2] = 0
    C.mj_forward(model, data)
    in_c = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    # The wall is two meters away.
    wall = model.geom("wall").id
    assert in_c == {tuple(sorted(x[:2])) for x in ground.pairs(model) if wall not in x[:2]}


def test_a_foot_that_is_a_mesh_gets_a_box():
    """As high over the floor as the mesh; mass and looks are the mesh's, the name is the box's."""
    spec = robot(SHOE)
    model = spec.compile()
    mended = edits.mend(spec)
    after = mended.spec.compile()
    assert mended.edits[-1] == "a box collides in place of the mesh of front_foot, hind_foot"
    assert refusals.best_in_c(after) is None
    for name in ("front_foot", "hind_foot"):
        assert after.geom(name).type == C.mjtGeom.mjGEOM_BOX
        assert after.geom(f"{name}_mesh").type == C.mjtGeom.mjGEOM_MESH
        gaps = [
            C.mj_geomDistance(
                *(x, ground.first_pose(x), x.geom("floor").id, x.geom(name).id), 1, np.zeros(6)
            )
            for x in (model, after)
        ]
        assert gaps[0] == pytest.approx(gaps[1], abs=1e-7)  # vertices are float32
        np.testing.assert_allclose(after.geom(name).size, [0.1, 0.05, 0.04], atol=1e-6)
    np.testing.assert_allclose(after.body_inertia, model.body_inertia, rtol=1e-12)
    np.testing.assert_allclose(after.body_mass, model.body_mass, rtol=1e-12)


CART = """<mujoco>{}<worldbody>
  <geom name="rail" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
  <body name="cart"><joint name="x" type="slide" axis="1 0 0" {}/>
  <geom name="wheel" size=".1" {}/><site name="s"/></body></worldbody>
  <actuator><{} joint="x" name="push" gear="3" {}/></actuator>{}</mujoco>"""
#: What is changed -> parts of a model that MJX refuses without it.
CHANGES = {
    'solver="Newton" in place of PGS': ('<option solver="PGS"/>',),
    'integrator="implicitfast"': ('<option integrator="implicit"/>',),
    'integrator="Euler", since there is a fluid': (
        '<option integrator="implicitfast" density="1"/>',
    ),
    'iterations="100" ls_iterations="50"': ('<option solver="CG" iterations="3"/>',),
    "noslip_iterations removed": ('<option noslip_iterations="3"/>',),
    "sleep removed": ('<option><flag sleep="enable"/></option>',),
    "flags nativeccd and multiccd not disabled": ('<option><flag nativeccd="disable"/></option>',),
    "adhesion removed from wheel": ("", "", 'adhesion="1"'),
    "fluid_ellipsoid removed from wheel": ("", "", 'fluidshape="ellipsoid"'),
    "surfacevel removed from wheel": ("", "", 'surfacevel="1 0 0 0 0 0"'),
    "actearly removed from push": (*("", "", "", "general"), 'dyntype="filter" actearly="true"'),
    "armature of actuator push given to joint x": ("", "", "", "motor", 'armature="2"'),
    "damping of actuator push given to joint x": ("", "", "", "motor", 'damping="2"'),
    "sensors removed: apart": (
        *("", "", "", "motor", ""),
        '<sensor><distance name="apart" geom1="rail" geom2="wheel"/></sensor>',
    ),
    "a material for rangefinders added": (
        *("", "", "", "motor", ""),
        '<sensor><rangefinder site="s"/></sensor>',
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_mjx_refuses_is_changed(change):
    parts = (*CHANGES[change], *("", "", "", "motor", "", "")[len(CHANGES[change]) :])
    spec = read(CART.format(*parts))
    with pytest.raises(refusals.UnsupportedError):
        refusals.check_supported(spec.compile(), "the model")
    mended = edits.mend(spec)
    assert mended.edits == [change]
    refusals.check_supported(models.load_model(mended.spec), "the model")


@pytest.mark.parametrize("attribute", ["armature", "damping"])
def test_what_a_joint_takes_over_moves_it_as_before(attribute):
    spec = read(CART.format("", f'{attribute}="1"', "", "motor", f'{attribute}="2"', ""))
    speeds = []
    for model in (spec.compile(), edits.mend(spec).spec.compile()):
        data = C.MjData(model)
        data.ctrl[:] = 1
        C.mj_step(model, data, 10)
        speeds.append(data.qvel[0])
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-12)


PART = """<body {}><joint name="{}" type="slide"/><geom type="{}" size=".1 .1 .1" margin=".01"/>
  {}</body>"""
ARM = '<mujoco><worldbody>{}</worldbody><actuator><motor joint="a"/></actuator></mujoco>'


def test_a_robot_is_kept_from_itself_where_mjx_lacks_the_contact():
    """Of bodies that hang together, which may have no names; others stay, and are named."""
    middle = (
        '<body><joint name="b"/><geom size=".01" contype="0" conaffinity="0" mass="1"/>{}</body>'
    )
    arm = PART.format("", "a", "box", middle.format(PART.format("", "c", "cylinder", "")))
    mended = edits.mend(read(ARM.format(arm)))
    assert mended.edits == ["kept apart: body_1 and body_3"]
    assert refusals.best_in_c(mended.spec.compile()) is None
    two = PART.format("", "a", "box", "") + PART.format("", "b", "cylinder", "")
    mended = edits.mend(read(ARM.format(two)))
    assert mended.edits == []
    assert "box on cylinder" in refusals.best_in_c(mended.spec.compile())


def test_boxes_on_boxes_lose_their_margin():
    two = PART.format("", "a", "box", "") + PART.format('name="cube"', "b", "box", "")
    mended = edits.mend(read(ARM.format(two)))
    assert mended.edits == [
        "margin and gap removed from geom 0 of body number 1, geom 0 of body cube"
    ]
    assert refusals.best_in_c(mended.spec.compile()) is None


@pytest.mark.parametrize("name", ["scene.xml", "robots/arm/arm.xml"])
def test_a_written_model_is_the_model(tmp_path, name):
    """With the files of a model that it attaches, and with what has no mass."""
    arm = tmp_path / "robots" / "arm"
    for folder in ("shapes", "looks"):
        (arm / folder).mkdir(parents=True)
    (arm / "arm.xml").write_text(LIMB)
    (arm / "shapes" / "hand.obj").write_text(TETRAHEDRON)
    for picture in ("shapes/hills.png", "looks/grass.png"):
        Image.fromarray(np.arange(16, dtype=np.uint8).reshape(4, 4)).save(arm / picture)
    (tmp_path / "scene.xml").write_text(ASSEMBLED)
    path = tmp_path / name
    spec = C.MjSpec.from_file(str(path))
    model = spec.compile()
    copy = path.with_name("copy.xml")
    copy.write_text(written.text(spec, copy.parent))
    read_again = C.MjModel.from_xml_path(str(copy))
    assert model.body_mass[-1] == 1
    for field in ("body_mass", "body_inertia", "mesh_vert", "hfield_data", "tex_data"):
        np.testing.assert_array_equal(getattr(read_again, field), getattr(model, field), field)


def test_a_motor_keeps_what_it_cannot_be_without():
    """MuJoCo compiles no DC motor that is not actearly."""
    motor = '<dcmotor joint="a" motorconst=".1" resistance="1"/>'
    slide = ARM.format(PART.format("", "a", "box", ""))
    assert edits.mend(read(slide.replace('<motor joint="a"/>', motor))).edits == []
