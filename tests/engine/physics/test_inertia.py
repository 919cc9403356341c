"""Solving with the inertia matrix from the leaves to the root: against C MuJoCo and MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.physics import contacts, inertia

#: A free body with two legs of two joints.
XML = """
<mujoco><option {option}/><worldbody><body pos="0 0 1"><freejoint/><geom size="0.2"/>
  <body pos="0.1 0.2 0"><joint axis="0 1 0" damping="2"/>
    <geom type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
    <body pos="0 0 -0.4"><joint axis="1 0 0"/>
      <geom type="capsule" size="0.04 0.2" pos="0 0 -0.2"/></body></body>
  <body pos="0.1 -0.2 0"><joint axis="0 1 0" damping="1"/>
    <geom type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
    <body pos="0 0 -0.4"><joint axis="1 0 0"/>
      <geom type="capsule" size="0.04 0.2" pos="0 0 -0.2"/></body></body>
</body></worldbody></mujoco>"""


def model_of(option=""):
    model = mujoco.MjModel.from_xml_string(XML.format(option=option))  # pyright: ignore
    return model, mjx.put_model(model, impl="jax")


def state(model, seed=0):
    """A random position and velocity, with all that follows from them in C."""
    random = np.random.default_rng(seed)
    data = mujoco.MjData(model)  # pyright: ignore
    data.qpos[:] += 0.3 * random.standard_normal(model.nq)
    data.qvel[:] = random.standard_normal(model.nv)
    mujoco.mj_forward(model, data)  # pyright: ignore
    return data, random.standard_normal(model.nv)


def written_out(fn, *args):
    """What machine code computes."""
    return jax.tree.map(lambda x: x[0], scalar.vmap(fn)(*jax.tree.map(lambda x: x[None], args)))


def at(model, in_jax, qpos, qvel):
    """Everything up to the constraints."""
    data = mjx.put_data(model, mujoco.MjData(model), impl="jax")  # pyright: ignore
    data = mjx.fwd_position(in_jax, data.replace(qpos=qpos, qvel=qvel))
    data = mjx.fwd_actuation(in_jax, mjx.fwd_velocity(in_jax, data))
    return inertia.fwd_acceleration(in_jax, data)


@pytest.mark.slow
def test_it_is_what_c_solves():
    with jax.enable_x64(True):
        model, in_jax = model_of()
        data, force = state(model)
        want = np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, want, force[None])  # pyright: ignore

        def both(qpos, qvel, force):
            reached = at(model, in_jax, qpos, qvel)
            return inertia.inverse_times(in_jax, reached, force), reached.qacc_smooth

        args = map(jnp.asarray, (data.qpos, data.qvel, force))
        solved, smooth = written_out(both, *args)
        np.testing.assert_allclose(solved, want[0], rtol=0, atol=1e-12 * np.abs(want).max())
        scale = np.abs(data.qacc_smooth).max()
        np.testing.assert_allclose(smooth, data.qacc_smooth, rtol=0, atol=1e-12 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("option", ["", 'jacobian="sparse"'])
def test_a_step_of_euler_is_that_of_mjx(option):
    """With damping, which is part of the matrix, in both of MJX's layouts."""
    with jax.enable_x64(True):
        model, in_jax = model_of(option)
        data, _ = state(model, 1)

        def moved(qpos, qvel, *steps):
            reached = at(model, in_jax, qpos, qvel)
            reached = reached.replace(qacc=reached.qacc_smooth)
            return [(after.qpos, after.qvel) for step in steps for after in [step(in_jax, reached)]]

        args = tuple(map(jnp.asarray, (data.qpos, data.qvel)))
        want, got = jax.jit(lambda *args: moved(*args, mjx.euler, inertia.euler))(*args)
        dense = not option  # machine code has no other
        alone = written_out(lambda *args: moved(*args, inertia.euler), *args) if dense else []
        for each in (got, *alone):
            for mine, theirs in zip(each, want, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_without_implicit_damping_euler_is_that_of_mjx():
    """The damping at the step's end would change the velocity."""
    model, damped = model_of()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # pyright: ignore
    in_jax = mjx.put_model(model, impl="jax")
    data, _ = state(model, 1)
    data = mjx.put_data(model, data, impl="jax")
    steps = (inertia.euler, in_jax), (mjx.euler, in_jax), (mjx.euler, damped)
    ours, theirs, other = jax.jit(lambda data: [step(mx, data).qvel for step, mx in steps])(data)
    np.testing.assert_array_equal(ours, theirs)
    assert not np.allclose(ours, other)


def test_tendon_armature_couples_what_it_does_in_c():
    """Siblings are not coupled, a parent and its child are."""
    xml = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/>
      <body pos=".1 0 0"><joint name="b"/><geom size=".1" pos=".1 .1 0"/></body>
      <body pos="-.1 0 0"><joint name="c"/><geom size=".1" pos="-.1 .1 0"/></body></body>
      </worldbody><tendon><fixed armature=".01"><joint joint="a" coef="1"/>
      <joint joint="b" coef="2"/><joint joint="c" coef="-1"/></fixed></tendon></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore
    in_jax, data = mjx.put_model(model, impl="jax"), mujoco.MjData(model)  # pyright: ignore
    data.qvel[:] = 1, 2, 3
    mujoco.mj_forward(model, data)  # pyright: ignore
    found = jax.jit(lambda data: contacts.fwd_position(in_jax, data))
    matrix = mjx.full_m(in_jax, found(mjx.put_data(model, data, impl="jax")))
    solved = np.linalg.solve(matrix, data.qfrc_smooth)
    assert matrix[0, 1] != 0
    np.testing.assert_allclose(solved, data.qacc_smooth, rtol=1e-5)


def test_zeros_stay_zeros():
    """A product is written for entries alone that a path from the root holds."""
    model, _ = model_of()
    coupled = np.eye(model.nv, dtype=bool)
    for dof, parent in enumerate(model.dof_parentid):
        coupled[dof] |= coupled[parent] if parent >= 0 else False
    above = coupled.sum(axis=1) - 1  # degrees of freedom between each and the root
    assert above.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 6, 7]

    def solve(matrix, force):
        return inertia._from_leaves(jnp.where(coupled | coupled.T, matrix, 0), force)

    size = model.nv
    operations = scalar.scalarize(solve, jnp.eye(size), jnp.ones(size)).operations
    assert operations["sub"] == (above * (above + 1) // 2).sum() + 2 * above.sum()
    assert operations["div"] == size  # each pivot is inverted once
