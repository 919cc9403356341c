"""Products with the Jacobian, at once and by contact, against NumPy's."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.physics import contact_rows

DIMS = np.array([3, 1, 6, 4, 3, 1])
NV = 5


@pytest.fixture(params=["in turn", "at once"])
def division(request, monkeypatch):
    def choose(one, whole, *operands, may_unroll):
        return (one if request.param == "in turn" else whole)(*operands)

    monkeypatch.setattr(contact_rows, "by_engine", choose)
    return contact_rows.blocks(2, DIMS)


def rows_of(division):
    """Which contact, in the order of the groups, each row is of; -1 for those of none."""
    sizes = [size for count, size in division.groups for _ in range(count)]
    return np.r_[[-1] * division.others, np.repeat(np.arange(len(sizes)), sizes)]


def problem(division, pushing):
    """Random rows, of which those of contacts that do not push have no mass and no force."""
    rng, contact = np.random.default_rng(0), rows_of(division)
    pushes = (contact < 0) | np.isin(contact, pushing)
    jacobian, force = rng.standard_normal((len(contact), NV)), rng.standard_normal(len(contact))
    mass = rng.uniform(1, 2, len(contact)) * pushes
    mass[5] = 0  # a row of a contact that pushes by its others
    return jacobian, mass, force * pushes


def test_rows_of_a_contact_are_two_for_each_direction_of_friction():
    made = contact_rows.blocks(7, DIMS, may_unroll=False)
    assert made == contact_rows.Blocks(7, ((2, 1), (2, 4), (1, 6), (1, 10)), False)
    assert contact_rows.blocks(0, np.array([3])).groups == ((1, 4),)


@pytest.mark.parametrize("pushing", [[], [0], [2, 3, 5], range(6)])
def test_weighted(division, pushing):
    jacobian, mass, force = problem(division, [*pushing])
    start = np.eye(NV) + 1
    made = contact_rows.weighted(division, *map(jnp.asarray, (start, jacobian, mass, force)))
    np.testing.assert_allclose(made[0], start + jacobian.T @ np.diag(mass) @ jacobian, rtol=1e-5)
    np.testing.assert_allclose(made[1], jacobian.T @ force, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("touching", [[], [1], [0, 2, 4], [3, 5], range(6)])
def test_along(division, touching):
    """Rows of contacts that do not touch are zero."""
    jacobian, direction = problem(division, range(6))[0], np.arange(1.0, NV + 1)
    contact = rows_of(division)
    touches = np.isin(np.arange(6), [*touching])
    jacobian[(contact >= 0) & ~touches[contact]] = 0
    made = contact_rows.along(division, *map(jnp.asarray, (jacobian, direction, touches)))
    np.testing.assert_allclose(made, jacobian @ direction, rtol=1e-5, atol=1e-5)


def test_a_contact_that_does_not_touch_costs_no_product(monkeypatch):
    """Its rows are not read: they may hold anything."""
    monkeypatch.setattr(contact_rows, "by_engine", lambda one, _, *x, may_unroll: one(*x))
    division = contact_rows.blocks(0, np.array([3, 3]))
    jacobian = jnp.ones((8, NV)).at[4:].set(jnp.nan)
    made = contact_rows.along(division, jacobian, jnp.ones(NV), jnp.array([True, False]))
    np.testing.assert_array_equal(made, [NV] * 4 + [0] * 4)
