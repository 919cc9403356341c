"""Files that allow their solver few iterations, beside C MuJoCo with those iterations."""

import copy

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from experiments.checks import matrix
from experiments.checks.mechanisms import mechanisms
from mjx_reinforce.engine.physics import early_stop
from mjx_reinforce.envs import models

FEW = 'iterations="{}" ls_iterations="{}"'
#: A ball on a rope, in a nest of which it touches more capsules than machine code has room for.
CUP = """
<mujoco><option {few} timestep=".005"/><worldbody>
  <body name="cup" pos="0 0 .5"><joint name="x" type="slide" axis="1 0 0" frictionloss=".2"/>
    <joint type="slide" axis="0 0 1" stiffness="200"/><site name="a"/>
    <geom type="capsule" size=".01" fromto="-.06 -.1 .05 -.06 .1 .05"/>
    <geom type="capsule" size=".01" fromto="-.05 -.1 .01 -.05 .1 .01"/>
    <geom type="capsule" size=".01" fromto="-.03 -.1 -.02 -.03 .1 -.02"/>
    <geom type="capsule" size=".01" fromto="0 -.1 -.03 0 .1 -.03"/>
    <geom type="capsule" size=".01" fromto=".03 -.1 -.02 .03 .1 -.02"/>
    <geom type="capsule" size=".01" fromto=".05 -.1 .01 .05 .1 .01"/>
    <geom type="capsule" size=".01" fromto=".06 -.1 .05 .06 .1 .05"/></body>
  <body name="ball" pos="0 0 .525"><joint type="slide" axis="1 0 0"/>
    <joint type="slide" axis="0 0 1"/><site name="b"/><geom size=".047"/></body>
</worldbody>
<tendon><spatial range="0 .02" limited="true"><site site="a"/><site site="b"/></spatial></tendon>
<actuator><motor joint="x" gear="5"/></actuator></mujoco>"""
#: Two joint limits in a tree, whose optimum has a closed form, without damping.
ARM = """
<mujoco><option {few}/><worldbody>
  <body><joint name="a" axis="0 1 0" range="-6 6"/>
    <geom size=".04" type="capsule" fromto="0 0 0 .3 0 0" contype="0" conaffinity="0"/>
    <body pos=".3 0 0"><joint axis="0 1 0" range="-5 5"/>
      <geom size=".04" type="capsule" fromto="0 0 0 .3 0 .1" contype="0" conaffinity="0"/></body>
  </body></worldbody><actuator><motor joint="a"/></actuator></mujoco>"""


def plays(xml, *limits):
    """Returns a model, and where it starts: at its pose, in motion."""
    model = mujoco.MjModel.from_xml_string(xml.format(few=FEW.format(*limits)))  # pyright: ignore
    qvel = 0.5 * np.cos(1 + np.arange(model.nv))
    return model, (model.qpos0, qvel, np.zeros(0), np.ones(model.nu))


def by_c(model, start, steps):
    """Returns qpos and qvel after every step, [T, nq] and [T, nv], and the steps of the solver."""
    data = mujoco.MjData(model)  # pyright: ignore
    data.qpos[:], data.qvel[:], _, ctrl = start
    shown = []
    for _ in range(steps):
        data.ctrl[:] = matrix.control(ctrl, data.time)
        mujoco.mj_step(model, data)  # pyright: ignore
        shown.append((data.qpos.copy(), data.qvel.copy(), int(max(data.solver_niter))))
    return [np.stack(x) for x in zip(*shown, strict=True)]


def errors(shown, model, start, steps):
    """Returns the largest error, and how far C is from what it finds with many iterations."""
    qpos, qvel, taken = by_c(model, start, steps)
    assert taken.max() == model.opt.iterations
    many = copy.copy(model)
    many.opt.iterations, many.opt.ls_iterations = 100, 50
    far = np.abs(by_c(many, start, steps)[1] - qvel).max()
    ours = [shown[matrix.FIELDS.index(name)][0] for name in ("qpos", "qvel")]
    return max(np.abs(x - y).max() for x, y in zip(ours, (qpos, qvel), strict=True)), far


@pytest.mark.slow
@pytest.mark.parametrize("native", [False, True])
def test_more_contacts_than_room_end_where_c_does(native):
    """As Playground's ball_in_cup."""
    model, start = plays(CUP, 1, 4)
    with jax.enable_x64(True):
        if native:
            shown = matrix.by_machine_code(model, start, 20)
        else:
            shown = matrix.by_us(model, tuple(x[None] for x in start), 20)
    error, far = errors(shown, model, start, 20)
    assert error < 1e-9 < 1e-3 < far


@pytest.mark.slow
def test_limits_end_where_c_does():
    """Their closed form would be the optimum."""
    model, start = plays(ARM, 1, 2)
    with jax.enable_x64(True):
        shown = matrix.by_us(model, tuple(x[None] for x in start), 100)
    error, far = errors(shown, model, start, 100)
    assert error < 1e-9 < 1e-6 < far


def strayed(mechanism, start):
    """Returns how far C strays from itself if its start moves by 1e-12."""
    model = mujoco.MjModel.from_xml_string(mechanism.xml)  # pyright: ignore
    qpos, qvel, *others = mechanism.starts[start]
    moved = qvel + 1e-12 * np.random.default_rng(0).standard_normal(qvel.shape)
    both = (matrix.by_c_as_is(model, (qpos, x, *others), mechanism.steps) for x in (qvel, moved))
    return max(
        np.max(np.abs(x - y) / np.maximum(1, np.abs(y)), initial=0)
        for x, y in zip(*both, strict=True)
    )


@pytest.mark.slow
@pytest.mark.parametrize("limits", [FEW.format(1, 5), FEW.format(3, 5)])
def test_walkers_among_balls_end_where_c_does(limits):
    """Two walkers and what lies about them: contacts, limits, friction loss, many islands.

    One step of the solver a time step lets rounding grow, in C by up to a million.
    """
    chosen = {
        each.name: each
        for each in mechanisms()
        if each.title[:2] == ("iterations", limits) and "legs" in each.name
    }
    with jax.enable_x64(True):
        cells = list(matrix.compare([*chosen.values()]))
    assert len(cells) == 4 * len(chosen) == 8
    for cell in cells:
        assert cell.error < max(1e-9, strayed(chosen[cell.mechanism], cell.start)), cell


@pytest.mark.parametrize(
    ("few", "many"), [((19, 50), (20, 50)), ((100, 49), (100, 50)), ((1, 4), (100, 100))]
)
def test_what_few_are(few, many):
    model, _ = plays(ARM, *few)
    assert early_stop.stops_early(model)
    assert early_stop.stops_early(mjx.put_model(model))
    assert not early_stop.stops_early(plays(ARM, *many)[0])


@pytest.mark.parametrize("option", ['solver="CG"', 'cone="elliptic"'])
def test_what_c_alone_plays_is_refused(option):
    for few in (FEW.format(4, 10), FEW.format(100, 50)):
        model = mujoco.MjModel.from_xml_string(CUP.format(few=f"{few} {option}"))  # pyright: ignore
        if "100" in few:
            models.to_mjx(model, "it")
            continue
        with pytest.raises(ValueError, match=r'iterations \(4\).*set <option iterations="100"'):
            models.to_mjx(model, "it")
