"""The constraint solver of contact tasks against MJX's own, taken to the optimum."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import limits, newton, step
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_fields

SCENE = """
<mujoco>
  <option timestep="0.01" tolerance="0" cone="{cone}" solver="{solver}"/>
  <worldbody>
    <geom type="plane" size="5 5 1" {geom}/>
    <body name="a" pos="0 0 0.2"><freejoint/>
      <geom type="capsule" size="0.1 0.3"/>
      <body pos="0.2 0 0"><joint axis="0 1 0" range="-0.5 0.5" limited="true" {joint}/>
        <geom type="capsule" size="0.08 0.2" pos="0.2 0 0"/>
      </body>
    </body>
    <body name="b" pos="0.6 0 0.3"><freejoint/><geom type="sphere" size="0.15" {geom}/></body>
  </worldbody>
  <equality><connect body1="a" body2="b" anchor="0.3 0 0"/></equality>
</mujoco>
"""


def scene(cone="pyramidal", solver="Newton", joint="", geom=""):
    xml = SCENE.format(cone=cone, solver=solver, joint=joint, geom=geom)
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore
    return mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")


def rows_at(model, data, qpos, qvel, warmstart):
    """Everything that the solver reads."""
    data = mjx.fwd_position(model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart))
    data = mjx.fwd_actuation(model, mjx.fwd_velocity(model, data))
    return mjx.fwd_acceleration(model, data)


def random_states(model, count):
    random = np.random.default_rng(0)
    qpos = model.qpos0 + 0.2 * random.standard_normal((count, model.nq))
    qvel, warmstart = random.standard_normal((2, count, model.nv)) * [[[3.0]], [[30.0]]]
    return jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(warmstart)


@pytest.fixture(scope="module")
def problems():
    """A model and 64 problems: contacts of two dimensions, limit, equality, and friction loss."""
    with jax.enable_x64(True):
        model, data = scene(geom='condim="1"', joint='frictionloss="300"')
        assert {1, 3} == {*jax_fields(data).contact.dim}
        make = jax.jit(jax.vmap(functools.partial(rows_at, model, data)))
        return model, make(*random_states(model, 64))


@pytest.fixture(scope="module")
def solve(problems):
    """Solves problems within a number of steps, and as many of each line search."""
    models = {np.dtype(np.float64): problems[0], np.dtype(np.float32): in_single(problems[0])}

    @jax.jit
    def within(ready, cap):
        model = models[ready.qpos.dtype]
        model = model.replace(opt=model.opt.replace(iterations=cap, ls_iterations=cap))
        return jax.vmap(functools.partial(newton.solve_newton, model))(ready)

    def solved(ready, cap=100):
        with jax.enable_x64(ready.qpos.dtype == np.float64):
            return [np.asarray(x) for x in within(ready, cap)]

    return solved


def in_single(tree):
    def single(x):
        is_double = getattr(x, "dtype", None) == np.float64
        return np.asarray(x).astype(np.float32) if is_double else x

    return jax.tree.map(single, tree)


def assert_same_solutions(actual, expected, tolerance):
    for pair in zip(actual, expected, strict=True):
        ours, theirs = map(np.asarray, pair)
        scale = 1 + np.abs(theirs).max(axis=1, keepdims=True)
        assert np.max(np.abs(ours - theirs) / scale) < tolerance


@pytest.mark.slow
def test_finds_the_optimum_that_mjx_finds(problems, solve):
    """From good and bad starts."""
    model, ready = problems
    with jax.enable_x64(True):
        end = jax.jit(jax.vmap(functools.partial(mjx.solve, model)))(ready)
    expected = end.qacc, end.qfrc_constraint, jax_fields(end).efc_force
    assert (np.asarray(expected[2]) != 0).mean() > 0.1
    fields = jax_fields(ready)
    slides = np.abs(np.asarray(expected[2])) == np.asarray(fields.efc_frictionloss)
    assert 0.1 < slides[:, fields.ne : fields.ne + fields.nf].mean() < 0.9
    assert_same_solutions(solve(ready), expected, 1e-9)


@pytest.mark.slow
def test_in_loops_it_finds_the_same(problems, solve):
    """As for more contacts than there is room for."""
    model, ready = problems
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(functools.partial(newton.solve_in_loops, model)))(ready)
    assert_same_solutions(found, solve(ready), 1e-11)


@pytest.mark.slow
def test_ends_where_the_gradient_vanishes(problems, solve):
    """In single precision, of which there is no reference: the acceleration balances all forces."""
    model, ready = problems
    qacc, joint_force, _ = solve(in_single(ready))
    with jax.enable_x64(True):
        inertia = np.asarray(jax.vmap(functools.partial(mjx.full_m, model))(ready))
    forces = np.asarray(ready.qfrc_smooth) + joint_force
    left = np.einsum("bij,bj->bi", inertia, qacc) - forces
    scale = 1 + np.abs(forces).max(axis=1, keepdims=True)
    assert qacc.dtype == np.float32
    assert np.max(np.abs(left) / scale) < 1e-4


@pytest.mark.slow
def test_a_nan_ends_the_search(problems, solve):
    """It reaches the acceleration, and does not keep the other episodes waiting."""
    ready = in_single(problems[1])
    fields = jax_fields(ready)
    dirty = with_fields(ready, efc_aref=jnp.asarray(fields.efc_aref).at[2].set(jnp.nan))
    clean, broken = solve(ready)[0], solve(dirty)[0]
    assert np.isnan(broken[2]).all()
    np.testing.assert_array_equal(np.delete(broken, 2, 0), np.delete(clean, 2, 0))


def test_an_optimum_is_left_as_it_is():
    """A sphere that leaves the floor: no row pushes, and the gradient is zero to the last bit."""
    xml = """
    <mujoco><worldbody><geom type="plane" size="5 5 1"/>
      <body pos="0 0 0.099"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <geom type="sphere" size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore
    model, data = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    data = data.replace(qvel=data.qvel.at[2].set(5.0))
    qacc = jax.jit(lambda data: physics.forward(model, data).qacc)(data)
    np.testing.assert_allclose(qacc, [0, 0, -9.81, 0, 0, 0], atol=1e-6)


def test_other_models_go_to_mjx():
    for options, ours in (
        ({}, True),
        ({"cone": "elliptic"}, False),
        ({"solver": "CG"}, False),
    ):
        assert newton.supports(scene(**options)[0]) == ours, options


def test_every_task_with_contacts_is_solved_here():
    for name in envs.names():
        env = envs.make(name)
        if hasattr(env, "mj_model"):
            data = mjx.make_data(env.mj_model, impl="jax")
            assert newton.supports(env.model) or not jax_fields(data).ncon, name


# -------------------------------------------------------------------------------------------------
# Joint limits in closed form: against C MuJoCo's solution, and all sets of active rows.

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
def closed():
    def both(data):
        return limits.solve_limits(IN_JAX, data), limits.past_limit(IN_JAX, data)

    return jax.jit(both)


def test_the_acceleration_is_that_of_c(closed):
    for qpos, qvel in itertools.product(STATES, [(0, 0, 0, 0), (3, -2, 1, -4), (-3, 5, 0, 4)]):
        data = forward(qpos, qvel)
        (qacc, torque, force), past = closed(mjx.put_data(MODEL, data, impl="jax"))
        scale = 1 + np.abs(data.qacc).max()
        np.testing.assert_allclose(qacc / scale, data.qacc / scale, atol=2e-5)
        np.testing.assert_allclose(torque, data.qfrc_constraint, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(sum(force), sum(data.efc_force), rtol=1e-3, atol=1e-3)
        assert bool(past) == (data.nefc > 0)


def test_a_nan_is_past_the_limit(closed):
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
