"""Products with the Jacobian of the constraint rows, where few contacts touch.

A contact that does not touch has rows of zeros, and of those that touch not all push. Machine code
for one episode (``scalar``) skips such a contact by a branch. Where XLA computes many episodes at
once both sides of a branch would be computed, and there these are products of whole matrices.

The rows of a contact with friction are the edges n + t_i and n - t_i of a pyramid (MuJoCo's
documentation, "Computation", "Friction cones"). They lie in the space of n and all t_i, a basis of
fewer vectors, with which machine code computes. And it leaves out the degrees of freedom that no
contact can couple, such as two legs of Ant, of which each touches the floor alone.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics.mjx_internals import geom_groups
from mjx_reinforce.engine.scalar import is_written_out, short_scan, skippable

Pair = tuple[jax.Array, jax.Array]


class Group(NamedTuple):
    """Contacts with equally many rows.

    contacts: how many
    pyramid: [rows of a contact, vectors of its basis] the rows as sums of the vectors
    coupling: [nv, nv] whether rows of one of them may have both degrees of freedom
    """

    contacts: int
    pyramid: np.ndarray
    coupling: np.ndarray


class Blocks(NamedTuple):
    """How the rows divide.

    num_contact_free: of the leading rows, which belong to no contact
    groups: the contacts
    """

    num_contact_free: int
    groups: tuple[Group, ...]


class Jacobian(NamedTuple):
    """The rows, and for machine code the bases of the contacts.

    rows: [rows, nv]
    bases: of each group, [contacts, vectors, nv]; none where XLA compiles
    """

    rows: jax.Array
    bases: Sequence[jax.Array]


def blocks(num_contact_free: int, dims: np.ndarray, couplings: Mapping[int, np.ndarray]) -> Blocks:
    """Returns the division for contacts [C] of these dimensions under pyramidal cones.

    Args:
      num_contact_free: the rows of no contact, which come first.
      dims: [C]
      couplings: of ``couplings``.
    """
    # MJX orders contacts by their dimension, so that each group's rows are next to one another.
    groups = tuple(
        Group(int((dims == dim).sum()), _pyramid(dim), coupling)
        for dim, coupling in sorted(couplings.items())
        if (dims == dim).any()
    )
    return Blocks(num_contact_free, groups)


def couplings(model: mjx.Model) -> dict[int, np.ndarray]:
    """Returns for each dimension of contacts which degrees of freedom one of them may couple.

    A contact's rows have those that move one of its two bodies. The bools are [nv, nv].
    """
    is_moved = _moves(model)
    couplings: dict[int, np.ndarray] = {}
    for dim, geom1, geom2 in geom_groups(model):
        is_pair_moved = is_moved[model.geom_bodyid[geom1]] | is_moved[model.geom_bodyid[geom2]]
        couplings[dim] = couplings.get(dim, False) | np.outer(is_pair_moved, is_pair_moved)
    return couplings


def _moves(model: mjx.Model) -> np.ndarray:
    """Returns which degrees of freedom move a body, [nbody, nv]."""
    is_moved = model.dof_bodyid == np.arange(model.nbody)[:, None]
    for body in range(1, model.nbody):  # parents come first
        is_moved[body] |= is_moved[model.body_parentid[body]]
    return is_moved


def _pyramid(dim: int) -> np.ndarray:
    """Returns the edges [rows, dim] of a contact's pyramid: n + t_i, n - t_i; for one row, n."""
    if dim == 1:
        return np.eye(1)
    # C's order: both edges of one tangent (or of torsion, rolling), then those of the next.
    tangents = np.kron(np.eye(dim - 1), [[1.0], [-1.0]])
    return np.hstack([np.ones((len(tangents), 1)), tangents])


def with_bases(division: Blocks, rows: jax.Array, is_touching: jax.Array) -> Jacobian:
    """Returns the Jacobian of rows [rows, nv].

    Args:
      division: of the rows.
      rows: [rows, nv]
      is_touching: [C] whether a contact's rows may be other than zero.
    """
    if not is_written_out():
        return Jacobian(rows, [])

    bases = []
    group_rows = by_group(division, rows)
    touch_masks = _of_groups(division, is_touching)
    for group, contact_rows, touch_mask in zip(
        division.groups, group_rows, touch_masks, strict=True
    ):
        # A pyramid's columns are orthogonal: n is the mean of the edges, t_i half a difference.
        inverse = group.pyramid.T / np.sum(group.pyramid**2, 0)[:, None]
        basis = functools.partial(jnp.matmul, jnp.asarray(inverse, rows.dtype))
        bases.append(_of_touching(basis, contact_rows, touch_mask))
    return Jacobian(rows, bases)


def _of_touching(function: Callable, rows: jax.Array, is_touching: jax.Array) -> jax.Array:
    """Returns a function of the rows of each contact that touches; zeros for the others."""

    def apply(_: None, contact: tuple) -> tuple[None, jax.Array]:
        rows, touch = contact
        shape = jax.eval_shape(function, rows)
        zeros = jnp.zeros(shape.shape, shape.dtype)
        return None, skippable(touch, lambda: function(rows), zeros)

    return short_scan(apply, None, (rows, is_touching))[1]


def weighted(
    division: Blocks, start: jax.Array, jacobian: Jacobian, mass: jax.Array, force: jax.Array
) -> Pair:
    """Returns start [nv, nv] + J' diag(mass) J, and J' force [nv].

    Args:
      division: of the rows.
      start: [nv, nv] what the first product is added to.
      jacobian: of ``with_bases``.
      mass: [rows]; where all of a contact's are zero, its forces are zero too.
      force: [rows]
    """
    # Where XLA compiles, all rows are one product; written out, contacts follow one by one.
    dense_rows = slice(division.num_contact_free if is_written_out() else None)
    rows = jacobian.rows[dense_rows]
    sums = start + (rows.T * mass[dense_rows]) @ rows, rows.T @ force[dense_rows]
    if not is_written_out():
        return sums
    group_mass = by_group(division, mass)
    group_force = by_group(division, force)
    for group, *contacts in zip(
        division.groups, jacobian.bases, group_mass, group_force, strict=True
    ):
        pyramid = jnp.asarray(group.pyramid, start.dtype)

        def add_contact(
            sums: tuple, contact: tuple, pyramid: jax.Array = pyramid, group: Group = group
        ) -> tuple[tuple, None]:
            """Adds to both products what a contact's rows have; nothing if none of them pushes."""
            basis, mass, force = contact

            def add_rows() -> tuple:
                """Returns both products with the contact's part, computed in its basis."""
                hessian, qfrc_constraint = sums
                # J' D J = B' (P' D P) B, of rows J = P B: P' D P is smaller than D.
                weights = (pyramid.T * mass) @ pyramid @ basis
                total = _plus_product(hessian, basis.T[:, None], weights.T[None])
                return (
                    jnp.where(group.coupling, total, hessian),
                    _plus_product(qfrc_constraint, basis.T, pyramid.T @ force),
                )

            return skippable(jnp.any(mass != 0), add_rows, sums), None

        sums, _ = short_scan(add_contact, sums, tuple(contacts))
    return sums


def along(
    division: Blocks, jacobian: Jacobian, direction: jax.Array, is_touching: jax.Array
) -> jax.Array:
    """Returns J direction, [rows].

    Args:
      division: of the rows.
      jacobian: of ``with_bases``.
      direction: [nv]
      is_touching: [C] whether a contact's rows may be other than zero.
    """
    if not is_written_out():
        return jacobian.rows @ direction

    products = [jacobian.rows[: division.num_contact_free] @ direction]
    touch_masks = _of_groups(division, is_touching)
    for group, bases, touch_mask in zip(division.groups, jacobian.bases, touch_masks, strict=True):
        pyramid = jnp.asarray(group.pyramid, direction.dtype)
        product = lambda basis, pyramid=pyramid: pyramid @ (basis @ direction)  # noqa: E731
        products.append(_of_touching(product, bases, touch_mask).reshape(-1))
    return jnp.concatenate(products)


def _plus_product(start: jax.Array, factor1: jax.Array, factor2: jax.Array) -> jax.Array:
    """Returns start + sum over the last axis of factor1 * factor2.

    Each entry is added up from its start on: in machine code these are fused multiply-adds.
    """
    factor1, factor2 = jnp.broadcast_arrays(factor1, factor2)
    terms = jnp.concatenate([start[..., None], factor1], -1)
    factors = jnp.concatenate([jnp.ones_like(start)[..., None], factor2], -1)
    return jnp.einsum("...k,...k->...", terms, factors)


def _of_groups(division: Blocks, is_touching: jax.Array) -> list[jax.Array]:
    """Divides an array [C] into the groups' [contacts]."""
    bounds = np.cumsum([0, *(group.contacts for group in division.groups)])
    return [is_touching[start:stop] for start, stop in itertools.pairwise(bounds)]


def by_group(division: Blocks, rows: jax.Array) -> list[jax.Array]:
    """Divides an array [rows, ...] into the groups' [contacts, rows of a contact, ...]."""
    group_rows = []
    start = division.num_contact_free
    for group in division.groups:
        size = len(group.pyramid)
        stop = start + group.contacts * size
        group_rows.append(rows[start:stop].reshape(group.contacts, size, *rows.shape[1:]))
        start = stop
    return group_rows
