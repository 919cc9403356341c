"""Solves with the contacts that touch alone, in machine code of one episode.

A Humanoid's geoms can meet in 138 contacts, and some four of them touch at once, in every episode
others. Machine code plays several episodes in step: going through all contacts, it takes the time
of each that touches in any of them. So each episode's own are brought together first. XLA, which
would compute both sides of every branch, solves with the rows of all contacts.
"""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mujoco import mjx

from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact
from mjx_reinforce.engine.physics.rows import make_constraint
from mjx_reinforce.engine.scalar import is_written_out, skippable, writing_out

#: Acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
Solution = tuple[jax.Array, jax.Array, jax.Array]
#: (model, data with rows) -> solution
Solver = Callable[..., Solution]
#: Of the states of Gymnasium's tasks that random and trained policies led to, more than 99.9% had
#: room (700 to 24,000 states a task).
_CONTACTS_PER_DOF = 0.4
#: Loops over more contacts are not written out, whatever the engine.
_UNROLLABLE = 6
#: Of so many contacts it is asked at once whether one of them touches.
_BATCH_SIZE = 8


def solve_touching(
    solver: Solver,
    fallback: Solver,
    model: mjx.Model,
    data: mjx.Data,
    contacts_per_dof: float = _CONTACTS_PER_DOF,
) -> Solution:
    """Solves with the contacts that touch, or with all where more touch than there is room for.

    Where those that there is room for have more than half of the rows, it is not worth the branches
    (Pusher on an H200: 0.8 of the speed, 0.7 with a trained policy), and ``solver`` takes all.

    Args:
      solver: what solves; it takes fewer contacts than the model has.
      fallback: what solves where there is no room, which should be little code.
      model: an MJX model.
      data: with its constraint rows made.
      contacts_per_dof: for how many of each kind there is room, by degrees of freedom. More costs
        time in every solve.
    """
    contact = jax_fields(data).contact
    contacts_by_dim = [np.flatnonzero(contact.dim == dim) for dim in (1, 3, 4, 6)]
    kinds = [kind for kind in contacts_by_dim if kind.size]
    room = _room(model, contacts_per_dof)
    num_rows = jax_fields(data).efc_D.size
    num_saved = sum(_rows_of_one(contact, kind) * max(0, kind.size - room) for kind in kinds)
    if 2 * num_saved < num_rows or not is_written_out():
        return solver(model, data)
    return _with_few(solver, fallback, model, data, kinds, room)


def _room(model: mjx.Model, contacts_per_dof: float) -> int:
    """Returns for how many contacts of each kind there is room."""
    return math.ceil(contacts_per_dof * model.nv)


def _with_few(
    solver: Solver,
    fallback: Solver,
    model: mjx.Model,
    data: mjx.Data,
    kinds: list[np.ndarray],
    room: int,
) -> Solution:
    """Solves; the kinds are the numbers of the contacts of each dimension."""
    contact = jax_fields(data).contact
    is_touching = ~(contact.dist - contact.includemargin >= 0)  # a NaN counts as touching
    num_contact_rows = sum(_rows_of_one(contact, kind) * kind.size for kind in kinds)
    num_contact_free = jax_fields(data).efc_D.size - num_contact_rows

    def solve_few() -> Solution:
        """Solves with the contacts that were packed, whose rows are made again, at their places."""
        contacts = jax.tree.map(lambda *x: jnp.concatenate(x), *packed_contacts)
        dims = [np.full(min(kind.size, room), contact.dim[kind[0]]) for kind in kinds]
        with contextlib.nullcontext() if room <= _UNROLLABLE else writing_out():
            packed_data = with_contact(data, contacts, np.concatenate(dims))
            qacc, qfrc_constraint, force = solver(model, make_constraint(model, packed_data))
        # Both branches return the forces of all rows, zero where no contact touches.
        efc_force = [force[:num_contact_free]]
        start = num_contact_free
        for kind in kinds:
            size = _rows_of_one(contact, kind)
            stop = start + size * min(kind.size, room)
            efc_force.append(_unpack(force[start:stop].reshape(-1, size), is_touching[kind]))
            start = stop
        return qacc, qfrc_constraint, jnp.concatenate(efc_force)

    def solve_all() -> Solution:
        with writing_out():
            solution = fallback(model, make_constraint(model, data))
        return jax.tree.map(functools.partial(jnp.where, has_room), solution_of_few, solution)

    # Packed before the branch, which needs the counts.
    packed_contacts = []
    counts = []
    for kind in kinds:
        contacts = jax.tree.map(lambda x, kind=kind: x[kind], contact)
        kind_contacts, count = _pack(contacts, is_touching[kind], room)
        packed_contacts.append(kind_contacts)
        counts.append(count)
    has_room = jnp.all(jnp.stack(counts) <= room)
    solution_of_few = solve_few()
    # No condition: where one episode has no room, others that play in step with it have.
    return skippable(~has_room, solve_all, solution_of_few)


def _rows_of_one(contact: Any, kind: np.ndarray) -> int:
    """Returns how many rows each of these contacts has, under pyramidal cones."""
    return max(1, 2 * (int(contact.dim[kind[0]]) - 1))


def _pack(contacts: Any, is_touching: jax.Array, room: int) -> tuple[Any, jax.Array]:
    """Brings the first contacts that touch together, in their order.

    Args:
      contacts: [C, ...]
      is_touching: [C] which of them touch.
      room: for how many there is room.

    Returns:
      Contacts [room, ...], those that do not touch in the places left, and how many touch [].
    """
    if is_touching.size <= room:
        return contacts, jnp.int32(0)

    def add_contact(state: tuple, row: tuple) -> tuple[tuple, None]:
        """Puts a contact at the next place, if it touches."""
        contact, has_contact = row
        packed_contacts, count = state

        def put() -> tuple:
            # Past the last place nothing is written, but the count goes on: it says what fits.
            is_next_place = jnp.arange(room) == count

            def put_leaf(packed_leaf: jax.Array, leaf: jax.Array) -> jax.Array:
                return jnp.where(is_next_place.reshape(-1, *[1] * leaf.ndim), leaf, packed_leaf)

            return jax.tree.map(put_leaf, packed_contacts, contact), count + 1

        return lax.cond(has_contact, put, lambda: state), None

    def add_batch(state: tuple, batch: tuple) -> tuple[tuple, None]:
        """Puts each of a batch of contacts at its place, if one of them touches."""
        _, batch_mask = batch

        def add_each() -> tuple:
            leaves, tree = jax.tree.flatten(batch)
            next_state = state
            for row in zip(*leaves, strict=True):
                next_state, _ = add_contact(next_state, tree.unflatten(row))
            return next_state

        return lax.cond(jnp.any(batch_mask), add_each, lambda: state), None

    # Places without a contact hold one at an infinite distance: its rows are zeros.
    empty_contacts = jax.tree.map(lambda x: jnp.broadcast_to(x[0], (room, *x.shape[1:])), contacts)
    empty_contacts = empty_contacts.replace(dist=jnp.full(room, jnp.inf, contacts.dist.dtype))
    start = empty_contacts, jnp.int32(0)
    # In batches, most of which one test skips; then those that fill no batch.
    num_batched = is_touching.size // _BATCH_SIZE * _BATCH_SIZE
    rows = contacts, is_touching
    batches = jax.tree.map(lambda x: x[:num_batched].reshape(-1, _BATCH_SIZE, *x.shape[1:]), rows)
    remainder = jax.tree.map(lambda x: x[num_batched:], rows)
    return lax.scan(add_contact, lax.scan(add_batch, start, batches)[0], remainder)[0]


def _unpack(values: jax.Array, is_touching: jax.Array) -> jax.Array:
    """Returns the values [room, ...] of contacts that touch, and 0 for the others, [C * ...]."""
    if is_touching.size == len(values):
        return values.reshape(-1)

    # The order of ``_pack``: the n-th contact that touches is at place n.
    def read(count: jax.Array, is_held: jax.Array) -> tuple[jax.Array, jax.Array]:
        return lax.cond(
            is_held, lambda: (count + 1, values[count]), lambda: (count, jnp.zeros_like(values[0]))
        )

    return lax.scan(read, jnp.int32(0), is_touching)[1].reshape(-1)
