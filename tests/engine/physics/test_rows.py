"""Constraint rows, at once and one contact after the other, against C MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scenes import SCENE

from mjx_reinforce.engine.physics import rows
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

MODEL = mujoco.MjModel.from_xml_string(SCENE)  # pyright: ignore
MODEL.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def random_state(seed):
    """C's data of a random state in which something touches."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(MODEL)  # pyright: ignore
    data.qpos[:] = MODEL.qpos0 + 0.15 * rng.standard_normal(MODEL.nq)
    data.qpos[8] -= 0.25  # the cylinder touches
    data.qvel[:] = rng.standard_normal(MODEL.nv)
    mujoco.mj_forward(MODEL, data)  # pyright: ignore
    return data


def in_turn(one, whole, *operands, may_unroll):
    return one(*operands)


def at_once(one, whole, *operands, may_unroll):
    return whole(*operands)


@pytest.fixture(scope="module", params=[in_turn, at_once])
def made(request):
    """Makes the rows of C's data: Jacobian, reference, mass, position."""
    model = mjx.put_model(MODEL, impl="jax")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "by_engine", request.param)

        @jax.jit
        def make(data):
            fields = jax_fields(rows.make_constraint(model, data))
            return fields.efc_J, fields.efc_aref, fields.efc_D, fields.efc_pos

        def of(data):
            return [np.asarray(x) for x in make(mjx.put_data(MODEL, data, impl="jax"))]

        of(random_state(0))
        yield of


@pytest.mark.parametrize("seed", range(4))
def test_rows_are_those_of_c(made, seed):
    """Each of C's rows that is not zero is among ours, which has more rows of zeros than C."""
    data = random_state(seed)
    jacobian, reference, mass, position = made(data)
    theirs = data.efc_J.reshape(data.nefc, MODEL.nv)
    ours = set(np.flatnonzero(np.any(np.abs(jacobian) > 1e-5, axis=1)).tolist())
    some = np.any(np.abs(theirs) > 1e-5, axis=1)
    assert len(ours) == some.sum() > 6
    of_c = (theirs, data.efc_aref, data.efc_D, data.efc_pos)
    for row, aref, d, pos in zip(*(x[some] for x in of_c), strict=True):
        distance = np.abs(jacobian - row).max(axis=1)
        place = min(ours, key=lambda i: distance[i] + abs(reference[i] - aref))
        ours.remove(place)
        np.testing.assert_allclose(jacobian[place], row, atol=1e-5)
        np.testing.assert_allclose(reference[place], aref, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(mass[place], d, rtol=1e-3)
        np.testing.assert_allclose(position[place], pos, atol=1e-5)


def test_states_reach_limits_and_contacts_of_every_dimension():
    """What the test above compares."""
    found = {int(dim) for seed in range(4) for dim in random_state(seed).contact.dim}
    assert found >= {1, 3, 4, 6}
    kinds = {int(kind) for seed in range(4) for kind in random_state(seed).efc_type}
    assert int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT) in kinds


def test_a_disabled_constraint_has_no_row():
    disabled = mjx.put_model(MODEL, impl="jax")
    flag = mjx.DisableBit.CONSTRAINT
    disabled = disabled.replace(opt=disabled.opt.replace(disableflags=flag))
    data = mjx.put_data(MODEL, random_state(0), impl="jax")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "by_engine", lambda *_, **__: pytest.fail("it makes rows"))
        assert jnp.size(jax_fields(rows.make_constraint(disabled, data)).efc_J) == 0


HELD = """
<mujoco><worldbody>
  <body name="a" pos="0 0 1">
    <freejoint/><geom size=".1"/><site name="a" pos=".1 .02 0" euler="20 0 0"/>
  </body>
  <body name="b" pos=".5 0 1">
    <joint type="ball"/><geom size=".1"/><site name="b" pos="-.1 .02 .01"/>
    <body name="c" pos=".3 0 0"><joint axis="0 1 0"/><geom size=".05"/></body>
  </body>
  <body name="hand" mocap="true" pos=".9 .3 1" euler="0 60 0"/>
</worldbody><equality>
  <weld site1="a" site2="b" torquescale=".4"/><connect body1="a" body2="c" anchor=".1 0 .02"/>
  <weld body1="c" body2="hand" relpose=".1 0 0 1 0 0 0"/>
</equality></mujoco>
"""


@pytest.mark.slow
def test_connects_and_welds_ask_for_what_c_asks():
    """With the change of the Jacobian, which MJX leaves out."""
    model = mujoco.MjModel.from_xml_string(HELD)  # pyright: ignore
    data, rng = mujoco.MjData(model), np.random.default_rng(0)  # pyright: ignore
    mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 0.3)  # pyright: ignore
    data.qvel[:] = 3 * rng.standard_normal(model.nv)
    mujoco.mj_forward(model, data)  # pyright: ignore
    with jax.enable_x64(True):
        ours, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")

        @jax.jit
        def both(data):
            made = rows.make_constraint(ours, data), mjx.make_constraint(ours, data)
            return [jax_fields(each).efc_aref for each in made]

        found, plain = both(start)
    connect_first = [*range(6, 9), *range(6), *range(9, 15)]
    theirs = data.efc_aref[connect_first]
    np.testing.assert_allclose(found[:15], theirs, rtol=1e-10, atol=1e-10)
    assert np.abs(found[:15] - plain[:15]).max() > 1
