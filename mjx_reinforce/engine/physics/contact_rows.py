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
    coupled: [nv, nv] whether rows of one of them may have both degrees of freedom
    """

    contacts: int
    pyramid: np.ndarray
    coupled: np.ndarray


class Blocks(NamedTuple):
    """How the rows divide.

    others: the leading rows, which belong to no contact
    groups: the contacts
    """

    others: int
    groups: tuple[Group, ...]


class Jacobian(NamedTuple):
    """The rows, and for machine code the bases of the contacts.

    rows: [rows, nv]
    bases: of each group, [contacts, vectors, nv]; none where XLA compiles
    """

    rows: jax.Array
    bases: Sequence[jax.Array]


def blocks(others: int, dims: np.ndarray, couplings: Mapping[int, np.ndarray]) -> Blocks:
    """Returns the division for contacts [C] of these dimensions under pyramidal cones.

    Args:
      others: the rows of no contact, which come first.
      dims: [C]
      couplings: of ``couplings``.
    """
    groups = tuple(
        Group(int((dims == dim).sum()), _pyramid(dim), coupled)
        for dim, coupled in sorted(couplings.items())
        if (dims == dim).any()
    )
    return Blocks(others, groups)


def couplings(model: mjx.Model) -> dict[int, np.ndarray]:
    """Returns for each dimension of contacts which degrees of freedom one of them may couple.

    A contact's rows have those that move one of its two bodies. The bools are [nv, nv].
    """
    moves = _moves(model)
    found: dict[int, np.ndarray] = {}
    for dim, first, second in geom_groups(model):
        either = moves[model.geom_bodyid[first]] | moves[model.geom_bodyid[second]]
        found[dim] = found.get(dim, False) | np.outer(either, either)
    return found


def _moves(model: mjx.Model) -> np.ndarray:
    """Returns which degrees of freedom move a body, [nbody, nv]."""
    moves = model.dof_bodyid == np.arange(model.nbody)[:, None]
    for body in range(1, model.nbody):  # parents come first
        moves[body] |= moves[model.body_parentid[body]]
    return moves


def _pyramid(dim: int) -> np.ndarray:
    """Returns the edges [rows, dim] of a contact's pyramid: n + t_i, n - t_i; for one row, n."""
    if dim == 1:
        return np.eye(1)
    tangents = np.kron(np.eye(dim - 1), [[1.0], [-1.0]])
    return np.hstack([np.ones((len(tangents), 1)), tangents])


def with_bases(division: Blocks, rows: jax.Array, touching: jax.Array) -> Jacobian:
    """Returns the Jacobian of rows [rows, nv].

    Args:
      division: of the rows.
      rows: [rows, nv]
      touching: [C] whether a contact's rows may be other than zero.
    """
    if not is_written_out():
        return Jacobian(rows, [])

    bases, parts = [], (by_group(division, rows), _of_groups(division, touching))
    for group, *each in zip(division.groups, *parts, strict=True):
        inverse = group.pyramid.T / np.sum(group.pyramid**2, 0)[:, None]
        basis = functools.partial(jnp.matmul, jnp.asarray(inverse, rows.dtype))
        bases.append(_of_touching(basis, *each))
    return Jacobian(rows, bases)


def _of_touching(function: Callable, rows: jax.Array, touching: jax.Array) -> jax.Array:
    """Returns a function of the rows of each contact that touches; zeros for the others."""

    def of_one(_: None, one: tuple) -> tuple[None, jax.Array]:
        rows, touches = one
        made = jax.eval_shape(function, rows)
        zeros = jnp.zeros(made.shape, made.dtype)
        return None, skippable(touches, lambda: function(rows), zeros)

    return short_scan(of_one, None, (rows, touching))[1]


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
    others = slice(division.others if is_written_out() else None)
    rows = jacobian.rows[others]
    sums = start + (rows.T * mass[others]) @ rows, rows.T @ force[others]
    if not is_written_out():
        return sums
    parts = by_group(division, mass), by_group(division, force)
    for group, basis, *each in zip(division.groups, jacobian.bases, *parts, strict=True):
        pyramid = jnp.asarray(group.pyramid, start.dtype)

        def add(
            sums: tuple, one: tuple, pyramid: jax.Array = pyramid, group: Group = group
        ) -> tuple[tuple, None]:
            basis, mass, force = one

            def pushed() -> tuple:
                hessian, joint_force = sums
                weights = (pyramid.T * mass) @ pyramid @ basis
                added = _plus_product(hessian, basis.T[:, None], weights.T[None])
                return (
                    jnp.where(group.coupled, added, hessian),
                    _plus_product(joint_force, basis.T, pyramid.T @ force),
                )

            return skippable(jnp.any(mass != 0), pushed, sums), None

        sums, _ = short_scan(add, sums, (basis, *each))
    return sums


def along(
    division: Blocks, jacobian: Jacobian, direction: jax.Array, touching: jax.Array
) -> jax.Array:
    """Returns J direction, [rows].

    Args:
      division: of the rows.
      jacobian: of ``with_bases``.
      direction: [nv]
      touching: [C] whether a contact's rows may be other than zero.
    """
    if not is_written_out():
        return jacobian.rows @ direction

    products = [jacobian.rows[: division.others] @ direction]
    parts = jacobian.bases, _of_groups(division, touching)
    for group, *each in zip(division.groups, *parts, strict=True):
        pyramid = jnp.asarray(group.pyramid, direction.dtype)
        product = lambda basis, pyramid=pyramid: pyramid @ (basis @ direction)  # noqa: E731
        products.append(_of_touching(product, *each).reshape(-1))
    return jnp.concatenate(products)


def _plus_product(start: jax.Array, left: jax.Array, right: jax.Array) -> jax.Array:
    """Returns start + sum over the last axis of left * right.

    Each entry is added up from its start on: in machine code these are fused multiply-adds.
    """
    left, right = jnp.broadcast_arrays(left, right)
    terms = jnp.concatenate([start[..., None], left], -1)
    factors = jnp.concatenate([jnp.ones_like(start)[..., None], right], -1)
    return jnp.einsum("...k,...k->...", terms, factors)


def _of_groups(division: Blocks, touching: jax.Array) -> list[jax.Array]:
    """Divides an array [C] into the groups' [contacts]."""
    ends = np.cumsum([0, *(group.contacts for group in division.groups)])
    return [touching[first:last] for first, last in itertools.pairwise(ends)]


def by_group(division: Blocks, rows: jax.Array) -> list[jax.Array]:
    """Divides an array [rows, ...] into the groups' [contacts, rows of a contact, ...]."""
    divided, first = [], division.others
    for group in division.groups:
        size = len(group.pyramid)
        last = first + group.contacts * size
        divided.append(rows[first:last].reshape(group.contacts, size, *rows.shape[1:]))
        first = last
    return divided
