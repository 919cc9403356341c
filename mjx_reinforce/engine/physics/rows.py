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
from mjx_reinforce.engine.physics.mjx_internals import (
    jax_fields,
    rows_of,
    with_contact,
    with_fields,
    with_rows,
)
from mjx_reinforce.engine.scalar import is_written_out, short_scan

_ONLY_CONTACTS = mjx.DisableBit.EQUALITY | mjx.DisableBit.FRICTIONLOSS | mjx.DisableBit.LIMIT
_NO_EQUALITY = mjx.DisableBit.EQUALITY | mjx.DisableBit.CONSTRAINT
#: Equalities whose rows come first, and how many rows each has.
_NUM_ROWS = {mjx.EqType.CONNECT: 3, mjx.EqType.WELD: 6}


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Makes the constraint rows, as ``mjx.make_constraint``, with the exception above.

    Of a contact that does not touch only the Jacobian and the reference, both zero, are right.
    """
    contact = jax_fields(data).contact
    is_disabled = model.opt.disableflags & mjx.DisableBit.CONSTRAINT
    if is_disabled or not contact.dim.size or not is_written_out():
        return _with_changes(model, make_rows(model, data))

    # First the rows of no contact: MJX makes none of contacts whose list of dimensions is empty.
    blocks = [rows_of(make_rows(model, with_contact(data, contact, np.zeros(0, int))))]
    # In MJX's order, which is that of the dimensions.
    for dim in (1, 3, 4, 6):
        indices = np.flatnonzero(contact.dim == dim)
        if indices.size:
            blocks.append(_contact_rows(model, data, int(dim), indices))
    rows = [jnp.concatenate(field) for field in zip(*blocks, strict=True)]
    return _with_changes(model, with_rows(data, rows))


def _with_changes(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Returns the data with references of connects and welds that are smaller by dJ/dt qvel.

    The derivative is that along the motion of the positions.
    """
    num_rows = sum(rows * int(np.sum(model.eq_type == kind)) for kind, rows in _NUM_ROWS.items())
    if not num_rows or model.opt.disableflags & _NO_EQUALITY:
        return data
    no_contact = with_contact(data, jax_fields(data).contact, np.zeros(0, int))

    def speed(qpos: jax.Array) -> jax.Array:
        """Returns J(qpos) qvel [rows] of the connects and welds, at the velocity of the data."""
        moved_data = mjx_internals.kinematics(model, no_contact.replace(qpos=qpos))
        moved_data = mjx.com_pos(model, moved_data)
        return jax_fields(make_rows(model, moved_data)).efc_J[:num_rows] @ data.qvel

    # The acceleration of a row is J qacc + dJ/dt qvel. The second is known before the solver, which
    # sees J qacc alone: it moves to ``efc_aref``.
    _, change = jax.jvp(speed, (data.qpos,), (_rate(model, data),))
    aref = jax_fields(data).efc_aref
    return with_fields(data, efc_aref=aref.at[:num_rows].add(-change))


def _rate(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the change of the positions [nq] in a second."""
    joints = zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True)
    rates = []
    for joint_type, qposadr, dofadr in joints:
        if joint_type in (mjx.JointType.SLIDE, mjx.JointType.HINGE):
            rates.append(data.qvel[dofadr : dofadr + 1])
            continue
        if joint_type == mjx.JointType.FREE:
            rates.append(data.qvel[dofadr : dofadr + 3])
            qposadr += 3
            dofadr += 3
        # q' = q w / 2, with the angular velocity w in the body's frame.
        angular_velocity = data.qvel[dofadr : dofadr + 3]
        quaternion = data.qpos[qposadr : qposadr + 4]
        rates.append(mjx_internals.quat_mul_axis(quaternion, angular_velocity) / 2)
    return jnp.concatenate(rates)


def _contact_rows(model: mjx.Model, data: mjx.Data, dim: int, indices: np.ndarray) -> list[Any]:
    """Makes the rows of these contacts, all of one dimension, in a loop."""
    disableflags = model.opt.disableflags | _ONLY_CONTACTS
    contacts_only = model.replace(opt=model.opt.replace(disableflags=disableflags))
    contact = jax_fields(data).contact

    def make(_: None, contact: Any) -> tuple[None, list[jax.Array]]:
        """Makes the rows of one contact, zeros if it does not touch."""

        def touching() -> list[jax.Array]:
            batch = jax.tree.map(lambda x: x[None], contact)
            return rows_of(make_rows(contacts_only, with_contact(data, batch, np.array([dim]))))

        shapes = jax.eval_shape(touching)
        return None, lax.cond(
            contact.dist - contact.includemargin >= 0,
            lambda: [jnp.zeros(x.shape, x.dtype) for x in shapes],
            touching,
        )

    contacts = jax.tree.map(lambda x: x[indices], contact)
    rows = short_scan(make, None, contacts)[1]
    return [x.reshape(-1, *x.shape[2:]) for x in rows]
