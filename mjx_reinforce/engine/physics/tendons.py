"""Forces of spatial tendons on bodies: C MuJoCo 4.0 counts them as external forces, MJX does not.

A tendon pulls, or pushes, at each end of each straight piece of its path, along the piece.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjMINVAL, mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.physics import mjx_internals
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

_GEOMS = mjx.WrapType.SPHERE, mjx.WrapType.CYLINDER


class _Ends(NamedTuple):
    """Ends of straight pieces.

    body: [N] what is held there.
    at, toward: [N, 3] the end, and the other one (m).
    share: [N] of the tendon's force; 0 if there is no such piece.
    tendon: [N]
    """

    body: np.ndarray
    at: jax.Array
    toward: jax.Array
    share: jax.Array | np.ndarray
    tendon: np.ndarray


#: How pieces' fields are put together: what is known of the model alone stays so.
_JOIN = np.concatenate, *[jnp.concatenate] * 3, np.concatenate


def body_forces(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the force, and the torque about ``xipos``, of tendons on bodies, [nbody, 6] (N, Nm).

    Args:
      model: an MJX model with a spatial tendon.
      data: its data after the constraints were solved.
    """
    parts = zip(_JOIN, zip(*_pieces(model, data), strict=True), strict=True)
    joined: list[Any] = [join(part) for join, part in parts]
    ends = _Ends(*joined)
    along = ends.at - ends.toward
    length = jnp.linalg.norm(along, axis=1, keepdims=True)
    along = jnp.where(length < mjMINVAL, jnp.eye(3)[0], along / jnp.maximum(length, mjMINVAL))
    force = (_forces(model, data)[ends.tendon] * ends.share)[:, None] * along
    torque = jnp.cross(ends.at - data.xipos[ends.body], force)
    wrench = jnp.concatenate([force, torque], axis=1)
    return jnp.zeros_like(data.xfrc_applied).at[ends.body].add(wrench)


def _pieces(model: mjx.Model, data: mjx.Data) -> list[_Ends]:
    """Returns the ends of all pieces: from site to site, and those of a geom between two sites."""
    tendon = np.repeat(np.arange(model.ntendon), model.tendon_num)
    kind, pulley = model.wrap_type, model.wrap_type == mjx.WrapType.PULLEY
    divisor = np.ones(model.nwrap)
    for i in np.flatnonzero(pulley):
        divisor[i : np.searchsorted(tendon, tendon[i], "right")] = np.asarray(model.wrap_prm)[i]
    is_site = kind == mjx.WrapType.SITE
    plain = np.flatnonzero(is_site[:-1] & is_site[1:] & (tendon[:-1] == tendon[1:]))
    around = np.flatnonzero(np.isin(kind, _GEOMS))
    share = 1 / np.maximum(divisor, mjMINVAL)

    def bodies(elements: np.ndarray) -> np.ndarray:
        return model.site_bodyid[model.wrap_objid[elements]]

    def places(elements: np.ndarray) -> jax.Array:
        return data.site_xpos[model.wrap_objid[elements]]

    pieces = [
        _Ends(bodies(i), places(i), places(j), share[i], tendon[i])
        for i, j in ((plain, plain + 1), (plain + 1, plain))
    ]
    if around.size:
        touches, *points = mjx_internals.wrap_points(model, data, around)
        geom = model.geom_bodyid[model.wrap_objid[around]]
        for site, point, other in zip((-1, 1), points, (1, -1), strict=True):
            i, rest = around + site, (share[around], tendon[around])
            toward = jnp.where(touches[:, None], point, places(around + other))
            pieces.append(_Ends(bodies(i), places(i), toward, *rest))
            pieces.append(_Ends(geom, point, places(i), touches * rest[0], rest[1]))
    return pieces


def _forces(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the force of each tendon along its length, [ntendon] (N); if positive, it pushes."""
    fields = jax_fields(data)
    below, above = model.tendon_lengthspring.T - data.ten_length
    force = model.tendon_stiffness * (jnp.maximum(below, 0) + jnp.minimum(above, 0))
    force -= model.tendon_damping * fields.ten_velocity
    speeding = fields.ten_J @ data.qacc + mjx_internals.tendon_dot(model, data) @ data.qvel
    force -= model.tendon_armature * speeding
    moved = np.flatnonzero(model.actuator_trntype == mjx.TrnType.TENDON)
    by_actuators = model.actuator_gear[moved, 0] * data.actuator_force[moved]
    force = force.at[model.actuator_trnid[moved, 0]].add(by_actuators)
    return _with_rows(model, data, force)


def _with_rows(model: mjx.Model, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Adds the forces of the constraint rows of tendons, the last ones of their kinds."""
    fields, row = jax_fields(data), jax_fields(data).efc_force
    last = np.cumsum([fields.ne, fields.nf, fields.nl])
    equal = np.flatnonzero(model.eq_type == mjx.EqType.TENDON)
    rough = np.flatnonzero(mjx_internals.has_friction(model))
    limited = np.flatnonzero(model.tendon_limited)
    if fields.ne and equal.size:
        pull, first, other = row[last[0] - equal.size : last[0]], model.eq_obj1id, model.eq_obj2id
        apart = (data.ten_length - model.tendon_length0)[other[equal]]
        slopes = model.eq_data[equal, 1:5] * np.arange(1, 5)
        slope = jnp.sum(slopes * apart[:, None] ** np.arange(4), axis=1)
        force = force.at[first[equal]].add(pull)
        force = force.at[other[equal]].add(jnp.where(other[equal] < 0, 0, -slope * pull))
    if fields.nf and rough.size:
        force = force.at[rough].add(row[last[1] - rough.size : last[1]])
    if fields.nl and limited.size:
        below, above = (model.tendon_range.T - data.ten_length)[:, limited]
        sign = jnp.where(-below < above, 1, -1)
        force = force.at[limited].add(sign * row[last[2] - limited.size : last[2]])
    return force
