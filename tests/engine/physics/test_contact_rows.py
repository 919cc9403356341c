"""Products with the Jacobian, at once and by contact, against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import contact_rows
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact

DIMS = np.array([3, 1, 6, 4, 3, 1])
NV = 5
#: Any contact may couple any degrees of freedom.
ANY = np.ones((NV, NV), bool)


@pytest.fixture(params=["in turn", "at once"])
def division(request, monkeypatch):
    def choose(one, whole, *operands, may_unroll):
        return (one if request.param == "in turn" else whole)(*operands)

    monkeypatch.setattr(contact_rows, "by_engine", choose)
    return contact_rows.blocks(2, DIMS, dict.fromkeys((1, 3, 4, 6), ANY))


def rows_of(division):
    """Which contact, in the order of the groups, each row is of; -1 for those of none."""
    sizes = [len(group.pyramid) for group in division.groups for _ in range(group.contacts)]
    return np.r_[[-1] * division.others, np.repeat(np.arange(len(sizes)), sizes)]


def jacobian_of(division):
    """Random rows; those of a contact are the edges of a pyramid."""
    rng, parts = np.random.default_rng(0), []
    for group in division.groups:
        bases = rng.standard_normal((group.contacts, group.pyramid.shape[1], NV))
        parts.append((group.pyramid @ bases).reshape(-1, NV))
    return np.concatenate([rng.standard_normal((division.others, NV)), *parts])


def problem(division, pushing):
    """Random rows, of which those of contacts that do not push have no mass and no force."""
    rng, contact = np.random.default_rng(0), rows_of(division)
    pushes = (contact < 0) | np.isin(contact, pushing)
    jacobian, force = jacobian_of(division), rng.standard_normal(len(contact))
    mass = rng.uniform(1, 2, len(contact)) * pushes
    mass[5] = 0  # a row of a contact that pushes by its others
    return jacobian, mass, force * pushes


def with_bases(division, rows, touching=True):
    touches = jnp.broadcast_to(jnp.asarray(touching), len(DIMS))
    return contact_rows.with_bases(division, jnp.asarray(rows), touches)


def test_rows_of_a_contact_are_two_for_each_direction_of_friction():
    couplings = dict.fromkeys((1, 3, 4, 6), ANY)
    made = contact_rows.blocks(7, DIMS, couplings, may_unroll=False)
    sizes = [(group.contacts, group.pyramid.shape) for group in made.groups]
    assert sizes == [(2, (1, 1)), (2, (4, 3)), (1, (6, 4)), (1, (10, 6))]
    assert (made.others, made.may_unroll) == (7, False)
    (group,) = contact_rows.blocks(0, np.array([3]), couplings).groups
    np.testing.assert_array_equal(group.pyramid, [[1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1]])


@pytest.mark.parametrize("pushing", [[], [2, 3, 5], range(6)])
def test_weighted(division, pushing):
    rows, mass, force = problem(division, [*pushing])
    start = np.eye(NV) + 1
    jacobian = with_bases(division, rows)
    made = contact_rows.weighted(
        division, jnp.asarray(start), jacobian, jnp.asarray(mass), jnp.asarray(force)
    )
    np.testing.assert_allclose(made[0], start + rows.T @ np.diag(mass) @ rows, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(made[1], rows.T @ force, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("touching", [[], [0, 2, 4], range(6)])
def test_along(division, touching):
    """Rows of contacts that do not touch are zero."""
    rows, direction = jacobian_of(division), np.arange(1.0, NV + 1)
    contact = rows_of(division)
    touches = np.isin(np.arange(6), [*touching])
    rows[(contact >= 0) & ~touches[contact]] = 0
    jacobian = with_bases(division, rows, touches)
    made = contact_rows.along(division, jacobian, jnp.asarray(direction), jnp.asarray(touches))
    np.testing.assert_allclose(made, rows @ direction, rtol=1e-5, atol=1e-5)


def test_a_contact_that_does_not_touch_costs_no_product(monkeypatch):
    """Its rows are not read: they may hold anything."""
    monkeypatch.setattr(contact_rows, "by_engine", lambda one, _, *x, may_unroll: one(*x))
    division = contact_rows.blocks(0, np.array([3, 3]), {3: ANY})
    rows, touching = jnp.ones((8, NV)).at[4:].set(jnp.nan), jnp.array([True, False])
    jacobian = contact_rows.with_bases(division, rows, touching)
    made = contact_rows.along(division, jacobian, jnp.ones(NV), touching)
    np.testing.assert_array_equal(made, [NV] * 4 + [0] * 4)


@pytest.mark.parametrize("env_id", ["Ant-v5", pytest.param("Humanoid-v5", marks=pytest.mark.slow)])
def test_what_no_contact_couples_is_zero_in_every_jacobian(env_id):
    """Against MJX's rows with all contacts touching, at random poses."""
    env = envs.make(env_id)
    model = mjx.put_model(env.mj_model, impl="jax")
    couplings = contact_rows.couplings(model)

    @jax.jit
    def jacobians(qpos):
        data = mjx.make_data(env.mj_model, impl="jax").replace(qpos=qpos)
        data = mjx.collision(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))
        contact = jax_fields(data).contact
        touching = contact.replace(dist=jnp.full_like(contact.dist, -0.01))
        data = mjx.make_constraint(model, with_contact(data, touching, contact.dim))
        return jax_fields(data).efc_J

    fields = jax_fields(mjx.make_data(env.mj_model, impl="jax"))
    others = fields.ne + fields.nf + fields.nl
    division = contact_rows.blocks(others, fields.contact.dim, couplings)
    rng, first = np.random.default_rng(0), others
    poses = env.mj_model.qpos0 + 0.1 * rng.standard_normal((3, model.nq))
    rows = sum(np.abs(jacobians(pose)) for pose in poses)
    for group in division.groups:
        last = first + group.contacts * len(group.pyramid)
        block = np.asarray(rows[first:last]).reshape(group.contacts, -1, model.nv).max(1)
        found = (block[:, :, None] * block[:, None, :]).max(0) > 0
        assert not np.any(found & ~group.coupled)
        first = last
    assert first == len(rows)


def test_two_legs_of_ant_meet_in_no_contact():
    """Each touches the floor alone: of 105 entries of the Hessian 24 are zero."""
    model = mjx.put_model(envs.make("Ant-v5").mj_model, impl="jax")
    ((dim, coupled),) = contact_rows.couplings(model).items()
    assert (dim, np.tril(coupled).sum()) == (3, 105 - 24)
