"""MJX's constraint rows; for machine code of one episode, those of contacts one after the other.

Few contacts touch. MJX makes the rows of all of them at once, which is best where XLA computes many
episodes; machine code for one episode is a loop over the contacts that makes the rows of those that
touch.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mujoco import mjx

from mjx_reinforce.fused import by_engine
from mjx_reinforce.physics.mjx_internals import (
    jax_fields,
    rows_of,
    with_contact,
    with_rows,
)

_NO_OTHERS = mjx.DisableBit.EQUALITY | mjx.DisableBit.FRICTIONLOSS | mjx.DisableBit.LIMIT


def make_constraint(model: mjx.Model, data: mjx.Data, may_unroll: bool = True) -> mjx.Data:
    """Makes the constraint rows, as ``mjx.make_constraint``.

    Of a contact that does not touch only the Jacobian and the reference, both zero, are right.
    ``may_unroll`` is that of loops over contacts, see ``fused.by_engine``.
    """
    contact = jax_fields(data).contact
    if model.opt.disableflags & mjx.DisableBit.CONSTRAINT or not contact.dim.size:
        return mjx.make_constraint(model, data)

    def whole() -> list[jax.Array]:
        return rows_of(mjx.make_constraint(model, data))

    def in_turn() -> list[jax.Array]:
        parts = [rows_of(mjx.make_constraint(model, with_contact(data, contact, np.zeros(0, int))))]
        for dim in (1, 3, 4, 6):
            chosen = np.flatnonzero(contact.dim == dim)
            if chosen.size:
                parts.append(_contact_rows(model, data, int(dim), chosen))
        return [jnp.concatenate(part) for part in zip(*parts, strict=True)]

    return with_rows(data, by_engine(in_turn, whole, may_unroll=may_unroll))


def _contact_rows(model: mjx.Model, data: mjx.Data, dim: int, chosen: np.ndarray) -> list[Any]:
    """Makes the rows of these contacts, all of one dimension, in a loop."""
    alone = model.replace(opt=model.opt.replace(disableflags=model.opt.disableflags | _NO_OTHERS))
    contact = jax_fields(data).contact

    def make(_: None, one: Any) -> tuple[None, list[jax.Array]]:
        def touching() -> list[jax.Array]:
            single = jax.tree.map(lambda x: x[None], one)
            return rows_of(mjx.make_constraint(alone, with_contact(data, single, np.array([dim]))))

        shapes = jax.eval_shape(touching)
        return None, lax.cond(
            one.dist - one.includemargin >= 0,
            lambda: [jnp.zeros(x.shape, x.dtype) for x in shapes],
            touching,
        )

    contacts = jax.tree.map(lambda x: x[chosen], contact)
    rows = lax.scan(make, None, contacts)[1]
    return [x.reshape(-1, *x.shape[2:]) for x in rows]
