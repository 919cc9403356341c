"""The constraint solver of contact tasks against MJX's own, taken to the optimum."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import contact_rows, newton
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
    """A model and 64 problems: contacts of two dimensions, a limit and an equality together."""
    with jax.enable_x64(True):
        model, data = scene(geom='condim="1"')
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
    assert_same_solutions(solve(ready), expected, 1e-9)


@pytest.mark.slow
def test_in_loops_it_finds_the_same(problems, solve):
    """As for more contacts than there is room for."""
    model, ready = problems
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(functools.partial(newton.solve_in_loops, model)))(ready)
    assert_same_solutions(found, solve(ready), 1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("double", [True, False])
def test_ends_where_the_gradient_vanishes(problems, solve, double):
    """No reference: the acceleration balances all forces."""
    model, ready = problems
    qacc, joint_force, _ = solve(ready if double else in_single(ready))
    with jax.enable_x64(True):
        inertia = np.asarray(jax.vmap(functools.partial(mjx.full_m, model))(ready))
    forces = np.asarray(ready.qfrc_smooth) + joint_force
    left = np.einsum("bij,bj->bi", inertia, qacc) - forces
    scale = 1 + np.abs(forces).max(axis=1, keepdims=True)
    assert qacc.dtype == (np.float64 if double else np.float32)
    assert np.max(np.abs(left) / scale) < (1e-10 if double else 1e-4)


def test_the_line_search_finds_the_root_among_kinks():
    """Against the least of the costs on a fine grid."""
    random = np.random.default_rng(1)
    for _ in range(20):
        residual, change = random.standard_normal((2, 12))
        mass = 10 ** random.uniform(-1, 3, 12)
        none = contact_rows.Jacobian(jnp.zeros((12, 1)), [])
        rows = newton.Rows(none, jnp.zeros(12), jnp.asarray(mass), jnp.array(False))
        active = residual < 0
        curvature = random.uniform(0.1, 1)
        row_slope, row_curvature = mass * change * residual, mass * change**2
        # Newton's own line has its root at a step of 1.
        slope = -(curvature + (row_slope + row_curvature)[active].sum())
        zero = jnp.zeros(())
        start = newton._Point(zero, zero, jnp.asarray(residual))
        without_rows = newton.Line(jnp.asarray(slope), jnp.asarray(curvature))
        found = newton._line_search(rows, start, jnp.asarray(change), without_rows, 50)

        def cost(length, args=(residual, change, mass, slope, curvature)):
            residual, change, mass, slope, curvature = args
            pushed = np.minimum(residual + np.multiply.outer(length, change), 0)
            penalty = (mass * pushed**2).sum(-1) / 2
            return slope * length + curvature * length**2 / 2 + penalty

        grid = np.linspace(0, 3 * abs(float(found)) + 1, 20_001)
        assert cost(np.float64(found)) <= cost(grid).min() + 1e-4 * abs(cost(grid).min())


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


@pytest.mark.slow
def test_caps_leave_no_more_cost_than_the_start(problems, solve):
    model, ready = problems
    fields = jax.tree.map(np.asarray, jax_fields(ready))
    with jax.enable_x64(True):
        inertia = np.asarray(jax.vmap(functools.partial(mjx.full_m, model))(ready))

    def cost(qacc):
        residual = np.einsum("brj,bj->br", fields.efc_J, qacc) - fields.efc_aref
        equality = np.arange(residual.shape[1]) < fields.ne
        pushed = np.where(equality | (residual < 0), residual, 0)
        offset = qacc - np.asarray(ready.qacc_smooth)
        inertial = np.einsum("bi,bij,bj->b", offset, inertia, offset)
        return (inertial + (fields.efc_D * pushed**2).sum(axis=1)) / 2

    before = cost(np.asarray(ready.qacc_smooth))
    for cap in (1, 2):
        after = cost(solve(ready, cap)[0])
        assert np.all(after <= before)
        assert np.median(after / before) < 0.5


def test_other_models_go_to_mjx():
    for options, ours in (
        ({}, True),
        ({"cone": "elliptic"}, False),
        ({"solver": "CG"}, False),
        ({"joint": 'frictionloss="1"'}, False),
    ):
        assert newton.supports(*scene(**options)) == ours, options


def test_every_task_with_contacts_is_solved_here():
    for name in envs.names():
        env = envs.make(name)
        if getattr(env, "num_contacts", 0):
            data = mjx.make_data(env.mj_model, impl="jax")
            assert newton.supports(env.model, data), name
