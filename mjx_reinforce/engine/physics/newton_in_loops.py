"""Newton's method of ``newton`` in little code, for what hardly ever happens.

Machine code comes here only if more contacts touch than ``touching`` has room for, and then solves
with all that there may be. What is written out for each of hundreds of rows, and for a factor of
the Hessian, was a quarter of Humanoid's program. Here all of that is loops, and the residuals are
computed again in each step, where ``newton`` carries them on: less code, and more time.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from mujoco import mjx

from mjx_reinforce.engine.physics import contact_rows, newton
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.engine.physics.newton import Line, Rows, Search
from mjx_reinforce.engine.scalar import skippable


def solve_in_loops(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds what ``newton.solve_newton`` does, from the unconstrained acceleration."""
    groups, inertia = _groups(model, data), mjx.full_m(model, data)
    smallest = newton.smallest_decrement(model, inertia)

    def improve(search: Search) -> Search:
        qacc, imbalance = search.point
        direction, decrement, residuals = _newton_direction(groups, inertia, *search.point)
        change_of_imbalance = inertia @ direction
        without_rows = Line(jnp.dot(direction, imbalance), jnp.dot(direction, change_of_imbalance))
        _, changes = _fold(lambda _, rows: (None, rows.jacobian @ direction), None, groups)

        def line(length: jax.Array) -> Line:
            def add(line: Line, one: tuple) -> tuple[Line, None]:
                rows, residual, change = one
                active = rows.active(residual + length * change)
                weighted = jnp.where(active, rows.constraint_mass * change, 0)
                return Line(
                    line.at_zero + jnp.dot(weighted, residual),
                    line.rate + jnp.dot(weighted, change),
                ), None

            return _fold(add, without_rows, groups, residuals, changes)[0]

        length = newton.root(line(jnp.zeros_like(decrement)), line, model.opt.ls_iterations)

        def compare(same: jax.Array, one: tuple) -> tuple[jax.Array, None]:
            rows, residual, change = one
            after = rows.active(residual + length * change)
            return same & jnp.all(after == rows.active(residual)), None

        same, _ = _fold(compare, jnp.array(True), groups, residuals, changes)
        after = qacc + length * direction, imbalance + length * change_of_imbalance
        return Search(after, search.steps + 1, same | (decrement < smallest))

    start = data.qacc_smooth, jnp.zeros_like(data.qacc_smooth)
    qacc, _ = newton.descend(model, improve, start)

    def push(joint_force: jax.Array, rows: Rows) -> tuple[jax.Array, jax.Array]:
        residual = rows.jacobian @ qacc - rows.reference
        force = rows.force(residual)
        return joint_force + rows.jacobian.T @ force, force

    joint_force, forces = _fold(push, jnp.zeros_like(qacc), groups)
    return qacc, joint_force, jnp.concatenate([force.reshape(-1) for force in forces])


def _groups(model: mjx.Model, data: mjx.Data) -> list[Rows]:
    """Divides the rows into those of no contact and those of the contacts of each dimension.

    The arrays are [contacts, rows of a contact, ...]; the rows of no contact are as if of one.
    """
    fields = jax_fields(data)
    others = fields.ne + fields.nf + fields.nl
    division = contact_rows.blocks(others, fields.contact.dim, contact_rows.couplings(model))
    equality = jnp.arange(fields.efc_D.size) < fields.ne
    rows = fields.efc_J, fields.efc_aref, fields.efc_D, equality
    contacts = zip(*(contact_rows.by_group(division, x) for x in rows), strict=True)
    return [Rows(*(x[None, :others] for x in rows)), *(Rows(*each) for each in contacts)]


def _fold(step: Callable, start: Any, *groups: Sequence) -> tuple[Any, list]:
    """Goes from contact to contact, as ``lax.scan``, through all groups.

    Args:
      step: (state, what a contact has) -> (state, result).
      start: the first state.
      *groups: what the contacts of each group have, [contacts, ...].

    Returns:
      The last state, and the results of each group.
    """
    state, results = start, []
    for contacts in zip(*groups, strict=True):
        state, made = lax.scan(step, state, contacts if len(groups) > 1 else contacts[0])
        results.append(made)
    return state, results


def _newton_direction(
    groups: list[Rows], inertia: jax.Array, qacc: jax.Array, imbalance: jax.Array
) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """Returns the step [nv], by how much the cost would fall [], see ``newton``, and residuals."""

    def add(sums: tuple, rows: Rows) -> tuple[tuple, jax.Array]:
        residual = rows.jacobian @ qacc - rows.reference
        mass = jnp.where(rows.active(residual), rows.constraint_mass, 0)

        def pushed() -> tuple:
            hessian, gradient = sums
            weighted = rows.jacobian.T * mass
            return hessian + weighted @ rows.jacobian, gradient + weighted @ residual

        return skippable(jnp.any(mass != 0), pushed, sums), residual

    (hessian, gradient), residuals = _fold(add, (inertia, imbalance), groups)
    direction = -_inverse_times(hessian, gradient)
    return direction, -jnp.dot(gradient, direction) / 2, residuals


def _inverse_times(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Returns inv(matrix) right, [nv], for a positive definite matrix [nv, nv].

    Each round eliminates the first of the unknowns that are left, and moves the others up by one
    place, so that all rounds are the same code.
    """

    def eliminate(left: tuple, _: None) -> tuple[tuple, tuple]:
        matrix, right = left
        column, inverse = matrix[:, 0], 1 / matrix[0, 0]
        factors = column * inverse
        matrix, rest = matrix - factors[:, None] * column, right - factors * right[0]
        moved = jnp.pad(matrix[1:, 1:], (0, 1)), jnp.pad(rest[1:], (0, 1))
        return moved, (factors[1:], right[0] * inverse)

    def substitute(known: jax.Array, eliminated: tuple) -> tuple[jax.Array, None]:
        factors, value = eliminated
        return jnp.append(value - jnp.dot(factors, known[:-1]), known[:-1]), None

    _, eliminated = lax.scan(eliminate, (matrix, right), None, len(right))
    return lax.scan(substitute, jnp.zeros_like(right), eliminated, reverse=True)[0]
