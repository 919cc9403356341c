"""Products with the Jacobian of the constraint rows, where few contacts touch.

A contact that does not touch has rows of zeros, and of those that touch not all push. Machine code
for one episode (``fused``) skips such a contact by a branch. Where XLA computes many episodes at
once both sides of a branch would be computed, and there these are products of whole matrices.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.fused import by_engine


class Blocks(NamedTuple):
    """How the rows divide.

    others: the leading rows, which belong to no contact
    groups: contacts with equally many rows: how many contacts, and how many rows each
    may_unroll: whether loops over contacts may be written out, see ``fused.by_engine``
    """

    others: int
    groups: tuple[tuple[int, int], ...]
    may_unroll: bool


def blocks(others: int, dims: np.ndarray, may_unroll: bool = True) -> Blocks:
    """Returns the division for contacts [C] of these dimensions under pyramidal cones."""
    kinds = [dim for dim in (1, 3, 4, 6) if (dims == dim).any()]
    rows = {dim: 1 if dim == 1 else 2 * (dim - 1) for dim in kinds}
    groups = tuple((int((dims == dim).sum()), rows[dim]) for dim in kinds)
    return Blocks(others, groups, may_unroll)


def weighted(
    division: Blocks, start: jax.Array, jacobian: jax.Array, mass: jax.Array, force: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns start [nv, nv] + J' diag(mass) J, and J' force [nv].

    Args:
      division: of the rows.
      start: [nv, nv] what the first product is added to.
      jacobian: [rows, nv]
      mass: [rows]; where all of a contact's are zero, its forces are zero too.
      force: [rows]
    """

    def whole(start: jax.Array, *rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        jacobian, mass, force = rows
        return start + (jacobian.T * mass) @ jacobian, jacobian.T @ force

    def by_contact(start: jax.Array, *rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        def add(sums: tuple, block: tuple) -> tuple[tuple, None]:
            def pushed(sums: tuple) -> tuple:
                return tuple(x + y for x, y in zip(sums, whole(zero, *block), strict=True))

            return lax.cond(jnp.any(block[1] != 0), pushed, lambda sums: sums, sums), None

        zero = jnp.zeros_like(start)
        sums = whole(start, *(x[: division.others] for x in rows))
        for group in _by_group(division, rows):
            sums, _ = lax.scan(add, sums, group)
        return sums

    operands = start, jacobian, mass, force
    return by_engine(by_contact, whole, *operands, may_unroll=division.may_unroll)


def along(
    division: Blocks, jacobian: jax.Array, direction: jax.Array, touching: jax.Array
) -> jax.Array:
    """Returns J direction, [rows].

    Args:
      division: of the rows.
      jacobian: [rows, nv]
      direction: [nv]
      touching: [C] whether a contact's rows may be other than zero.
    """

    def whole(jacobian: jax.Array, direction: jax.Array, touching: jax.Array) -> jax.Array:
        return jacobian @ direction

    def by_contact(jacobian: jax.Array, direction: jax.Array, touching: jax.Array) -> jax.Array:
        def product(_: None, block: tuple) -> tuple[None, jax.Array]:
            rows, touches = block
            zeros = jnp.zeros(rows.shape[0], rows.dtype)
            return None, lax.cond(touches, lambda: rows @ direction, lambda: zeros)

        parts, first = [jacobian[: division.others] @ direction], 0
        for (count, _), (rows,) in zip(
            division.groups, _by_group(division, (jacobian,)), strict=True
        ):
            block = rows, touching[first : first + count]
            parts.append(lax.scan(product, None, block)[1].reshape(-1))
            first += count
        return jnp.concatenate(parts)

    operands = jacobian, direction, touching
    return by_engine(by_contact, whole, *operands, may_unroll=division.may_unroll)


def _by_group(division: Blocks, rows: tuple) -> list[tuple]:
    """Divides arrays [rows, ...] into the groups' [contacts, rows of a contact, ...]."""
    divided, first = [], division.others
    for count, size in division.groups:
        last = first + count * size
        divided.append(tuple(x[first:last].reshape(count, size, *x.shape[1:]) for x in rows))
        first = last
    return divided
