"""The constraint solver of contact tasks against MJX's own, taken to the optimum."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import envs
from mjx_reinforce.physics import contact_rows, newton, newton_in_loops
from mjx_reinforce.physics import step as physics
from mjx_reinforce.physics.mjx_internals import jax_fields

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


def test_finds_the_optimum_that_mjx_finds():
    """Contacts, a limit and an equality constraint together, from good and bad starts."""
    with jax.enable_x64(True):
        model, data = scene()
        states = random_states(model, 64)

        def both(*state):
            ready = rows_at(model, data, *state)
            theirs = mjx.solve(model, ready)
            expected = theirs.qacc, theirs.qfrc_constraint, jax_fields(theirs).efc_force
            return newton.solve_newton(model, ready), expected

        actual, expected = jax.jit(jax.vmap(both))(*states)
    assert (np.asarray(expected[2]) != 0).mean() > 0.1
    for ours, theirs in zip(actual, expected, strict=True):
        scale = 1 + np.abs(theirs).max(axis=1, keepdims=True)
        assert np.max(np.abs(ours - theirs) / scale) < 1e-9


def test_in_loops_it_finds_the_same():
    """As for more contacts than there is room for; of two dimensions."""
    with jax.enable_x64(True):
        model, data = scene(geom='condim="1"')

        def both(*state):
            ready = rows_at(model, data, *state)
            return newton_in_loops.solve_in_loops(model, ready), newton.solve_newton(model, ready)

        actual, expected = jax.jit(jax.vmap(both))(*random_states(model, 64))
    assert {1, 3} == {*jax_fields(data).contact.dim}
    for ours, theirs in zip(actual, expected, strict=True):
        scale = 1 + np.abs(theirs).max(axis=1, keepdims=True)
        assert np.max(np.abs(ours - theirs) / scale) < 1e-11


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_ends_where_the_gradient_vanishes(dtype):
    """No reference: the acceleration balances all forces."""
    with jax.enable_x64(dtype == "float64"):
        model, data = scene()

        def imbalance(*state):
            ready = rows_at(model, data, *state)
            qacc, joint_force, _ = newton.solve_newton(model, ready)
            forces = ready.qfrc_smooth + joint_force
            return mjx.mul_m(model, ready, qacc) - forces, forces

        left, forces = jax.jit(jax.vmap(imbalance))(*random_states(model, 64))
    scale = 1 + np.abs(forces).max(axis=1, keepdims=True)
    assert left.dtype == dtype
    assert np.max(np.abs(left) / scale) < (1e-10 if dtype == "float64" else 1e-4)


def test_the_line_search_finds_the_root_among_kinks():
    """Against the least of the costs on a fine grid."""
    random = np.random.default_rng(1)
    for _ in range(20):
        residual, change = random.standard_normal((2, 12))
        mass = 10 ** random.uniform(-1, 3, 12)
        none = contact_rows.Jacobian(jnp.zeros((12, 1)), [])
        rows = newton._Rows(none, jnp.zeros(12), jnp.asarray(mass), jnp.array(False))
        active = residual < 0
        curvature = random.uniform(0.1, 1)
        row_slope, row_curvature = mass * change * residual, mass * change**2
        # Newton's own line has its root at a step of 1.
        slope = -(curvature + (row_slope + row_curvature)[active].sum())
        zero = jnp.zeros(())
        start = newton._Point(zero, zero, jnp.asarray(residual))
        found = newton._line_search(
            rows, start, jnp.asarray(change), jnp.asarray(slope), jnp.asarray(curvature), 50
        )

        def cost(length, args=(residual, change, mass, slope, curvature)):
            residual, change, mass, slope, curvature = args
            pushed = np.minimum(residual + np.multiply.outer(length, change), 0)
            penalty = (mass * pushed**2).sum(-1) / 2
            return slope * length + curvature * length**2 / 2 + penalty

        grid = np.linspace(0, 3 * abs(float(found)) + 1, 20_001)
        assert cost(np.float64(found)) <= cost(grid).min() + 1e-4 * abs(cost(grid).min())


def test_a_nan_ends_the_search():
    """It reaches the acceleration, and does not keep the other episodes waiting."""
    model, data = scene()
    qpos, qvel, warmstart = random_states(model, 4)
    solve = jax.jit(
        jax.vmap(lambda *state: newton.solve_newton(model, rows_at(model, data, *state))[0])
    )
    clean = solve(qpos, qvel, warmstart)
    dirty = solve(qpos, qvel.at[2].set(jnp.nan), warmstart)
    assert np.isnan(dirty[2]).all()
    np.testing.assert_array_equal(np.delete(dirty, 2, 0), np.delete(clean, 2, 0))


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


@pytest.mark.parametrize("cap", [1, 2])
def test_caps_leave_no_more_cost_than_the_start(cap):
    with jax.enable_x64(True):
        model, data = scene()
        opt = model.opt.replace(iterations=cap, ls_iterations=cap)
        capped = model.replace(opt=opt)

        def costs(*state):
            ready = rows_at(model, data, *state)
            fields = jax_fields(ready)

            def cost(qacc):
                residual = fields.efc_J @ qacc - fields.efc_aref
                equality = jnp.arange(residual.size) < fields.ne
                pushed = jnp.where(equality | (residual < 0), residual, 0)
                offset = qacc - ready.qacc_smooth
                inertial = offset @ mjx.mul_m(model, ready, offset)
                return (inertial + jnp.sum(fields.efc_D * pushed**2)) / 2

            return cost(newton.solve_newton(capped, ready)[0]), cost(ready.qacc_smooth)

        after, before = jax.jit(jax.vmap(costs))(*random_states(model, 64))
    assert np.all(np.asarray(after) <= np.asarray(before))
    assert np.median(np.asarray(after) / np.asarray(before)) < 0.5


@pytest.mark.parametrize(
    ("options", "ours"),
    [
        ({}, True),
        ({"cone": "elliptic"}, False),
        ({"solver": "CG"}, False),
        ({"joint": 'frictionloss="1"'}, False),
    ],
)
def test_other_models_go_to_mjx(options, ours):
    assert newton.supports(*scene(**options)) == ours


def test_every_task_with_contacts_is_solved_here():
    for name in envs.names():
        env = envs.make(name)
        if getattr(env, "num_contacts", 0):
            data = mjx.make_data(env.mj_model, impl="jax")
            assert newton.supports(env.model, data), name
