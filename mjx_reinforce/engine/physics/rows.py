"""MJX's constraint rows; for machine code of one episode, those of contacts one after the other.

What a connect or a weld asks for has the change of its Jacobian in it, as in C MuJoCo 4.0.

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

from mjx_reinforce.engine.physics import mjx_internals
from mjx_reinforce.engine.physics.impedance import make_constraint as make_rows
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, rows_of, with_contact, with_rows
from mjx_reinforce.engine.scalar import is_written_out, short_scan

_NO_OTHERS = mjx.DisableBit.EQUALITY | mjx.DisableBit.FRICTIONLOSS | mjx.DisableBit.LIMIT
_NO_EQUALITY = mjx.DisableBit.EQUALITY | mjx.DisableBit.CONSTRAINT
#: How many rows come first, each of so many.
_FIRST = {mjx.EqType.CONNECT: 3, mjx.EqType.WELD: 6}


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Makes the constraint rows, as ``mjx.make_constraint``, with the exception above.

    Of a contact that does not touch only the Jacobian and the reference, both zero, are right.
    """
    contact = jax_fields(data).contact
    none = model.opt.disableflags & mjx.DisableBit.CONSTRAINT or not contact.dim.size
    if none or not is_written_out():
        return _with_changes(model, make_rows(model, data))

    parts = [rows_of(make_rows(model, with_contact(data, contact, np.zeros(0, int))))]
    for dim in (1, 3, 4, 6):
        chosen = np.flatnonzero(contact.dim == dim)
        if chosen.size:
            parts.append(_contact_rows(model, data, int(dim), chosen))
    rows = [jnp.concatenate(part) for part in zip(*parts, strict=True)]
    return _with_changes(model, with_rows(data, rows))


def _with_changes(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Returns the data with references of connects and welds that are smaller by dJ/dt qvel.

    The derivative is that along the motion of the positions.
    """
    count = sum(rows * int(np.sum(model.eq_type == kind)) for kind, rows in _FIRST.items())
    if not count or model.opt.disableflags & _NO_EQUALITY:
        return data
    no_contact = with_contact(data, jax_fields(data).contact, np.zeros(0, int))

    def speed(qpos: jax.Array) -> jax.Array:
        moved = mjx.com_pos(model, mjx.kinematics(model, no_contact.replace(qpos=qpos)))
        return jax_fields(make_rows(model, moved)).efc_J[:count] @ data.qvel

    _, change = jax.jvp(speed, (data.qpos,), (_rate(model, data),))
    jacobian, mass, reference, *others = rows_of(data)
    return with_rows(data, [jacobian, mass, reference.at[:count].add(-change), *others])


def _rate(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the change of the positions [nq] in a second."""
    rates = []
    for kind, qpos, dof in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind in (mjx.JointType.SLIDE, mjx.JointType.HINGE):
            rates.append(data.qvel[dof : dof + 1])
            continue
        if kind == mjx.JointType.FREE:
            rates.append(data.qvel[dof : dof + 3])
            qpos, dof = qpos + 3, dof + 3
        turn = data.qvel[dof : dof + 3]
        rates.append(mjx_internals.quat_mul_axis(data.qpos[qpos : qpos + 4], turn) / 2)
    return jnp.concatenate(rates)


def _contact_rows(model: mjx.Model, data: mjx.Data, dim: int, chosen: np.ndarray) -> list[Any]:
    """Makes the rows of these contacts, all of one dimension, in a loop."""
    alone = model.replace(opt=model.opt.replace(disableflags=model.opt.disableflags | _NO_OTHERS))
    contact = jax_fields(data).contact

    def make(_: None, one: Any) -> tuple[None, list[jax.Array]]:
        def touching() -> list[jax.Array]:
            single = jax.tree.map(lambda x: x[None], one)
            return rows_of(make_rows(alone, with_contact(data, single, np.array([dim]))))

        shapes = jax.eval_shape(touching)
        return None, lax.cond(
            one.dist - one.includemargin >= 0,
            lambda: [jnp.zeros(x.shape, x.dtype) for x in shapes],
            touching,
        )

    contacts = jax.tree.map(lambda x: x[chosen], contact)
    rows = short_scan(make, None, contacts)[1]
    return [x.reshape(-1, *x.shape[2:]) for x in rows]
