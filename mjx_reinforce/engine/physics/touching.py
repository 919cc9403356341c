"""Solves with the contacts that touch alone, in machine code of one episode.

A Humanoid's geoms can meet in 138 contacts, and some four of them touch at once, in every episode
others. Machine code plays several episodes in step: going through all contacts, it takes the time
of each that touches in any of them. So each episode's own are brought together first. XLA, which
would compute both sides of every branch, solves with the rows of all contacts.
"""

import contextlib
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
from mjx_reinforce.engine.scalar import is_written_out, writing_out

#: Acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
Solution = tuple[jax.Array, jax.Array, jax.Array]
#: (model, data with rows) -> solution
Solver = Callable[..., Solution]
#: Loops over more contacts are not written out, whatever the engine.
_UNROLLABLE = 6
#: Of so many contacts it is asked at once whether one of them touches.
_AT_ONCE = 8


def solve_touching(solver: Solver, rarely: Solver, model: mjx.Model, data: mjx.Data) -> Solution:
    """Solves with the contacts that touch, or with all where more touch than there is room for.

    Where those that there is room for have more than half of the rows, it is not worth the branches
    (Pusher on an H200: 0.8 of the speed, 0.7 with a trained policy), and ``solver`` takes all.

    Args:
      solver: what solves; it takes fewer contacts than the model has.
      rarely: what solves where there is no room, which should be little code.
      model: an MJX model.
      data: with its constraint rows made.
    """
    contact = jax_fields(data).contact
    kinds = [k for dim in (1, 3, 4, 6) if (k := np.flatnonzero(contact.dim == dim)).size]
    room, rows = _room(model), jax_fields(data).efc_D.size
    saved = sum(_rows_of_one(contact, kind) * max(0, kind.size - room) for kind in kinds)
    if 2 * saved < rows or not is_written_out():
        return solver(model, data)
    return _with_few(solver, rarely, model, data, kinds, room)


def _room(model: mjx.Model) -> int:
    """Returns for how many contacts of each kind there is room.

    More room costs time in every solve. Of the states that random and trained policies led to, more
    than 99.9% had room (700 to 24,000 states a task).
    """
    return math.ceil(0.4 * model.nv)


def _with_few(
    solver: Solver,
    rarely: Solver,
    model: mjx.Model,
    data: mjx.Data,
    kinds: list[np.ndarray],
    room: int,
) -> Solution:
    """Solves; the kinds are the numbers of the contacts of each dimension."""
    contact = jax_fields(data).contact
    touching = ~(contact.dist - contact.includemargin >= 0)  # a NaN counts as touching
    num_others = jax_fields(data).efc_D.size - sum(_rows_of_one(contact, k) * k.size for k in kinds)

    def few() -> Solution:
        together = jax.tree.map(
            lambda *x: jnp.concatenate(x), *(contacts for contacts, _ in packed)
        )
        dims = [np.full(min(k.size, room), contact.dim[k[0]]) for k in kinds]
        with contextlib.nullcontext() if room <= _UNROLLABLE else writing_out():
            packed_data = with_contact(data, together, np.concatenate(dims))
            qacc, joint_force, force = solver(model, make_constraint(model, packed_data))
        parts, first = [force[:num_others]], num_others
        for kind in kinds:
            size = _rows_of_one(contact, kind)
            last = first + size * min(kind.size, room)
            parts.append(_unpack(force[first:last].reshape(-1, size), touching[kind]))
            first = last
        return qacc, joint_force, jnp.concatenate(parts)

    def every() -> Solution:
        with writing_out():
            return rarely(model, make_constraint(model, data))

    def packed_kind(kind: np.ndarray) -> tuple[Any, jax.Array]:
        return _pack(jax.tree.map(lambda x: x[kind], contact), touching[kind], room)

    packed = [packed_kind(kind) for kind in kinds]
    fits = jnp.all(jnp.stack([count for _, count in packed]) <= room)
    return lax.cond(fits, few, every)


def _rows_of_one(contact: Any, kind: np.ndarray) -> int:
    """Returns how many rows each of these contacts has, under pyramidal cones."""
    return max(1, 2 * (int(contact.dim[kind[0]]) - 1))


def _pack(contacts: Any, touching: jax.Array, room: int) -> tuple[Any, jax.Array]:
    """Brings the first contacts that touch together, in their order.

    Args:
      contacts: [C, ...]
      touching: [C] which of them touch.
      room: for how many there is room.

    Returns:
      Contacts [room, ...], those that do not touch in the places left, and how many touch [].
    """
    if touching.size <= room:
        return contacts, jnp.int32(0)

    def look(state: tuple, one: tuple) -> tuple[tuple, None]:
        contact, touches = one

        def put() -> tuple:
            here = jnp.arange(room) == state[1]
            place = lambda old, new: jnp.where(here.reshape(-1, *[1] * new.ndim), new, old)  # noqa: E731
            return jax.tree.map(place, state[0], contact), state[1] + 1

        return lax.cond(touches, put, lambda: state), None

    def look_at_some(state: tuple, some: tuple) -> tuple[tuple, None]:
        """Looks at each of a few contacts, if one of them touches."""

        def look_at_each() -> tuple:
            leaves, tree = jax.tree.flatten(some)
            after = state
            for one in zip(*leaves, strict=True):
                after, _ = look(after, tree.unflatten(one))
            return after

        return lax.cond(jnp.any(some[1]), look_at_each, lambda: state), None

    apart = jax.tree.map(lambda x: jnp.broadcast_to(x[0], (room, *x.shape[1:])), contacts)
    apart = apart.replace(dist=jnp.full(room, jnp.inf, contacts.dist.dtype))
    start = apart, jnp.int32(0)
    whole, rows = touching.size // _AT_ONCE * _AT_ONCE, (contacts, touching)
    some = jax.tree.map(lambda x: x[:whole].reshape(-1, _AT_ONCE, *x.shape[1:]), rows)
    rest = jax.tree.map(lambda x: x[whole:], rows)
    return lax.scan(look, lax.scan(look_at_some, start, some)[0], rest)[0]


def _unpack(values: jax.Array, touching: jax.Array) -> jax.Array:
    """Returns the values [room, ...] of contacts that touch, and 0 for the others, [C * ...]."""
    if touching.size == len(values):
        return values.reshape(-1)

    def give(count: jax.Array, touches: jax.Array) -> tuple[jax.Array, jax.Array]:
        return lax.cond(
            touches, lambda: (count + 1, values[count]), lambda: (count, jnp.zeros_like(values[0]))
        )

    return lax.scan(give, jnp.int32(0), touching)[1].reshape(-1)
