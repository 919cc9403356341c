"""Joint limits in closed form: against C MuJoCo's solution, and all sets of active rows."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine.physics import limits, step
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

XML = """
<mujoco><compiler angle="radian"/><option iterations="200" tolerance="1e-12"/><worldbody>
  <body><joint axis="0 1 0" range="-0.3 0.4" limited="true" margin="0.02"/>
    <geom size="0.05 0.3" type="capsule" pos="0.2 0 0" contype="0" conaffinity="0"/>
    <body pos="0.4 0 0"><joint axis="0 1 0" range="-0.5 0.2" limited="true"/>
      <geom size="0.05 0.2" type="capsule" pos="0.1 0 0.1" contype="0" conaffinity="0"/>
      <body pos="0.2 0 0.1"><joint type="slide" axis="1 0 0"/>
        <geom size="0.05" contype="0" conaffinity="0"/></body></body></body>
  <body pos="0 1 0"><joint type="slide" axis="0 0 1" range="-0.1 0.1" limited="true"/>
    <geom size="0.1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)  # pyright: ignore
IN_JAX = mjx.put_model(MODEL, impl="jax")
#: Past limits: none, each, both of the first tree (two ways), all; and within the margin alone.
STATES = [
    [0, 0, 0, 0],
    [0.45, 0, 0, 0],
    [0, 0.3, 0, 0],
    [0.45, 0.3, 0, 0],
    [-0.35, 0.25, 0.1, -0.2],
    [-0.35, -0.6, 0, 0.2],
    [0.39, 0, 0, 0],
]


def forward(qpos, qvel):
    data = mujoco.MjData(MODEL)  # pyright: ignore
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(MODEL, data)  # pyright: ignore
    return data


@pytest.fixture(scope="module")
def solve():
    def both(data):
        return limits.solve_limits(IN_JAX, data), limits.past_limit(IN_JAX, data)

    return jax.jit(both)


def test_the_acceleration_is_that_of_c(solve):
    for qpos, qvel in itertools.product(STATES, [(0, 0, 0, 0), (3, -2, 1, -4), (-3, 5, 0, 4)]):
        data = forward(qpos, qvel)
        (qacc, torque, force), past = solve(mjx.put_data(MODEL, data, impl="jax"))
        scale = 1 + np.abs(data.qacc).max()
        np.testing.assert_allclose(qacc / scale, data.qacc / scale, atol=2e-5)
        np.testing.assert_allclose(torque, data.qfrc_constraint, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(sum(force), sum(data.efc_force), rtol=1e-3, atol=1e-3)
        assert bool(past) == (data.nefc > 0)


def test_a_nan_is_past_the_limit(solve):
    data = mjx.put_data(MODEL, forward([0, 0, 0, 0], [0, 0, 0, 0]), impl="jax")
    assert not limits.past_limit(IN_JAX, data)
    assert limits.past_limit(IN_JAX, data.replace(qpos=data.qpos.at[1].set(jnp.nan)))
    assert not limits.past_limit(IN_JAX, data.replace(qpos=data.qpos.at[2].set(9.0)))  # unlimited


@pytest.mark.parametrize("size", [1, 2])
def test_the_forces_are_those_of_the_only_consistent_set(size):
    """Of random positive definite problems; the active rows are found by trying all sets."""
    rng, reached = np.random.default_rng(0), set()
    for _ in range(200):
        root = rng.standard_normal((size, size))
        matrix, target = root @ root.T, rng.standard_normal(size)
        mass = rng.uniform(0.5, 2, size)  # rows are scaled by it, and the matrix is not symmetric
        matrix = mass[:, None] * matrix
        found = np.array(limits._complementary(matrix.tolist(), target.tolist()))
        consistent = []
        for active in itertools.product([False, True], repeat=size):
            rows = np.flatnonzero(active)
            force = np.zeros(size)
            system = np.eye(rows.size) + matrix[np.ix_(rows, rows)]
            force[rows] = np.linalg.solve(system, target[rows])
            if np.allclose(force, np.maximum(0, target - matrix @ force), atol=1e-9):
                consistent.append(active)
                np.testing.assert_allclose(found, force, rtol=1e-4, atol=1e-5)
        assert len(consistent) == 1
        reached |= set(consistent)
    assert len(reached) == 2**size


def test_only_two_limits_to_a_tree_are_supported():
    for old, new, supported in (
        ("", "", True),
        ('<joint type="slide" axis="1 0 0"/>', '<joint range="-1 1" limited="true"/>', False),
        ('<joint axis="0 1 0" range="-0.5 0.2" limited="true"/>', "", True),
        ('contype="0" conaffinity="0"', "", False),
        ('range="-0.3 0.4"', 'range="-0.3 0.4" frictionloss="1"', False),
    ):
        xml = XML.replace(old, new) if old else XML
        model = mjx.put_model(mujoco.MjModel.from_xml_string(xml), impl="jax")  # pyright: ignore
        data = mjx.make_data(model, impl="jax")
        assert limits.supports(model, data) == supported, new


def test_as_many_rows_of_friction_are_no_limits():
    """With elliptic cones too, of no contact, with which MJX's solver fails."""
    friction = XML.replace('limited="true"', 'limited="true" frictionloss=".3"')
    option = ' cone="elliptic"><flag limit="disable"/></option><worldbody>'
    friction = friction.replace("/><worldbody>", option)
    model = mujoco.MjModel.from_xml_string(friction)  # pyright: ignore
    model.opt.tolerance = 0
    data = mujoco.MjData(model)  # pyright: ignore
    data.qpos[:], data.qvel[:] = STATES[4], (3, -2, 1, -4)
    mujoco.mj_forward(model, data)  # pyright: ignore
    with jax.enable_x64(True):
        in_jax, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")
        qacc = np.asarray(jax.jit(lambda data: step.solve_constraints(in_jax, data).qacc)(start))
    assert data.nefc == limits._limited_joints(in_jax).size
    np.testing.assert_allclose(qacc, data.qacc, rtol=1e-9)


@pytest.mark.slow
def test_rows_are_those_of_the_limited_joints():
    data = forward(STATES[4], (0, 0, 0, 0))
    rows = jax.jit(lambda data: jax_fields(mjx.make_constraint(IN_JAX, data)).efc_J)
    jacobian = rows(mjx.put_data(MODEL, data, impl="jax"))
    assert limits._limited_joints(IN_JAX).tolist() == [0, 1, 3]
    assert np.argmax(np.abs(jacobian), axis=1).tolist() == [0, 1, 3]
    assert limits._coupled_rows(IN_JAX, np.array([0, 1, 3])) == [[0, 1], [2]]
