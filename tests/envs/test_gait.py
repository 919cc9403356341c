"""Gaits: the feet of a model, what lifts them, and in which turn."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from on_legs import on_legs
from places import ROOT

from mjx_reinforce.envs import parts

QUADRUPED = ROOT / "experiments" / "examples" / "quadruped.xml"
PERIOD = 20
HEIGHT = 0.05


@pytest.fixture(scope="module")
def quadruped():
    return mujoco.MjModel.from_xml_path(str(QUADRUPED))


def foot_positions(model, geoms, controls):
    """Returns where geoms are [N, 3] when the servos' joints are where the controls say."""
    data = mujoco.MjData(model)
    addresses = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    data.qpos[addresses] += controls
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos[geoms]


@pytest.mark.parametrize("num_legs", [2, 4, 6])
def test_feet_are_lifted_straight_up_and_neighbors_in_turn(num_legs):
    model = mujoco.MjModel.from_xml_string(on_legs(num_legs))
    feet = parts.feet(model)
    names = {model.geom(foot.geom).name for foot in feet}
    assert names == {f"foot{leg}" for leg in range(num_legs)}
    geoms = [foot.geom for foot in feet]
    gait = parts.gait(model, HEIGHT, PERIOD)
    assert gait.shape == (PERIOD, model.nu)
    resting = foot_positions(model, geoms, np.zeros(model.nu))
    for step in range(PERIOD):
        moved = foot_positions(model, geoms, gait[step]) - resting
        heights = HEIGHT * np.sin(2 * np.pi * (step / PERIOD + np.arange(num_legs) / 2))
        # Half way up, a foot leaves the line by a little: the joints go in proportion.
        np.testing.assert_allclose(moved[:, 2], np.maximum(heights, 0), atol=0.1 * HEIGHT)
        np.testing.assert_allclose(moved[:, :2], 0, atol=0.15 * HEIGHT)
    highest = foot_positions(model, geoms, gait[PERIOD // 4]) - resting
    np.testing.assert_allclose(highest[::2], np.tile([0, 0, HEIGHT], (num_legs // 2, 1)), atol=1e-4)
    np.testing.assert_allclose(highest[1::2], 0, atol=1e-9)


def test_a_quadruped_trots(quadruped):
    feet = parts.feet(quadruped)
    sides = [tuple(np.sign(foot.position[:2])) for foot in feet]
    assert sides[::2] in ([(-1, -1), (1, 1)], [(1, -1), (-1, 1)])
    assert all(len(foot.joints) == 3 for foot in feet)


def test_legs_that_hang_on_one_waist_are_two():
    waist = '<body><joint name="waist" axis="0 0 1"/><geom size="0.03"/>'
    text = on_legs(2).replace('mass="5"/>', f'mass="5"/>{waist}')
    text = text.replace("</body></worldbody>", "</body></body></worldbody>")
    text = text.replace("<actuator>", '<actuator><position joint="waist"/>')
    model = mujoco.MjModel.from_xml_string(text)
    feet = parts.feet(model)
    assert [model.geom(foot.geom).name for foot in feet] == ["foot1", "foot0"]
    names = [[model.joint(joint).name for joint in foot.joints] for foot in feet]
    assert names == [["out1", "swing1", "knee1"], ["out0", "swing0", "knee0"]]
    gait = parts.gait(model, HEIGHT, PERIOD)
    assert not gait[:, 0].any()
    assert np.all(gait[:, 1:].any(axis=0))


def test_a_foot_that_only_a_pair_lets_touch_is_one(quadruped):
    spec = mujoco.MjSpec.from_file(str(QUADRUPED))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    spec.geoms[0].name = "floor"
    for number, geom in enumerate(spec.geoms[1:]):
        geom.name = f"part{number}"
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX and geom.parent.name != "torso":
            spec.add_pair(geomname1="floor", geomname2=geom.name)
    found = [foot.position for foot in parts.feet(spec.compile())]
    np.testing.assert_allclose(found, [foot.position for foot in parts.feet(quadruped)])


def test_a_model_without_feet_has_no_gait():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    assert parts.feet(model) == []
    with pytest.raises(ValueError, match=re.escape("two feet or more, and this model has 0")):
        parts.gait(model, HEIGHT, PERIOD)


def test_a_leg_that_does_not_reach_is_named(quadruped):
    """A straight one does not know which way to bend."""
    with pytest.raises(ValueError, match=r"geom \d+\) is not lifted by 1 m: its leg leaves"):
        parts.gait(quadruped, 1.0, PERIOD)
    text = on_legs(4).replace('euler="0 30 0"', "").replace('euler="0 -60 0"', "")
    straight = mujoco.MjModel.from_xml_string(text)
    assert len(parts.feet(straight)) == 4
    with pytest.raises(ValueError, match="bend the leg in the first key frame, or lift less"):
        parts.gait(straight, HEIGHT, PERIOD)


@pytest.mark.parametrize(
    ("height", "num_steps", "message"),
    [(np.nan, PERIOD, "height"), (-1.0, PERIOD, "height"), (HEIGHT, 0, "num_steps must be at")],
)
def test_a_gait_of_no_height_or_length_is_refused(quadruped, height, num_steps, message):
    with pytest.raises(ValueError, match=message):
        parts.gait(quadruped, height, num_steps)


def test_tables_and_clocks_repeat():
    table = np.arange(12.0).reshape(4, 3)
    steps = jnp.arange(9)
    rows = jax.vmap(lambda step: parts.cyclic(table, step))(steps)
    np.testing.assert_array_equal(rows, table[np.arange(9) % 4])
    clocks = jax.vmap(lambda step: parts.clock(step, 4))(steps)
    quarters = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
    np.testing.assert_allclose(clocks, quarters[np.arange(9) % 4], atol=1e-6)
