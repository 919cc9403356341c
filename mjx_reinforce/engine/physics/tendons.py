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
    columns = zip(_JOIN, zip(*_pieces(model, data), strict=True), strict=True)
    fields: list[Any] = [join(column) for join, column in columns]
    ends = _Ends(*fields)
    # As ``mju_normalize3``: a piece without length points along x.
    along = ends.at - ends.toward
    length = jnp.linalg.norm(along, axis=1, keepdims=True)
    along = jnp.where(length < mjMINVAL, jnp.eye(3)[0], along / jnp.maximum(length, mjMINVAL))
    force = (_forces(model, data)[ends.tendon] * ends.share)[:, None] * along
    torque = jnp.cross(ends.at - data.xipos[ends.body], force)
    wrench = jnp.concatenate([force, torque], axis=1)
    return jnp.zeros_like(data.xfrc_applied).at[ends.body].add(wrench)


def _pieces(model: mjx.Model, data: mjx.Data) -> list[_Ends]:
    """Returns the ends of all pieces: from site to site, and those of a geom between two sites."""
    # MuJoCo's ``wrap_*`` arrays are the paths of all tendons, one after the other. A pulley divides
    # the force of what follows it in its tendon.
    tendon = np.repeat(np.arange(model.ntendon), model.tendon_num)
    is_pulley = model.wrap_type == mjx.WrapType.PULLEY
    divisor = np.ones(model.nwrap)
    for i in np.flatnonzero(is_pulley):
        divisor[i : np.searchsorted(tendon, tendon[i], "right")] = np.asarray(model.wrap_prm)[i]
    is_site = model.wrap_type == mjx.WrapType.SITE
    straight = np.flatnonzero(is_site[:-1] & is_site[1:] & (tendon[:-1] == tendon[1:]))
    wrapped = np.flatnonzero(np.isin(model.wrap_type, _GEOMS))
    share = 1 / np.maximum(divisor, mjMINVAL)

    def bodies(elements: np.ndarray) -> np.ndarray:
        return model.site_bodyid[model.wrap_objid[elements]]

    def places(elements: np.ndarray) -> jax.Array:
        return data.site_xpos[model.wrap_objid[elements]]

    pieces = [
        _Ends(bodies(i), places(i), places(j), share[i], tendon[i])
        for i, j in ((straight, straight + 1), (straight + 1, straight))
    ]
    if wrapped.size:
        # From each site to where the tendon meets the geom; where it misses the geom, to the site
        # on the other side. The geom's body is pulled where the tendon meets it.
        touches, *points = mjx_internals.wrap_points(model, data, wrapped)
        geom_body = model.geom_bodyid[model.wrap_objid[wrapped]]
        for step, point in zip((-1, 1), points, strict=True):
            site = wrapped + step
            far_site = wrapped - step
            force_share = share[wrapped]
            of_tendon = tendon[wrapped]
            toward = jnp.where(touches[:, None], point, places(far_site))
            pieces.append(_Ends(bodies(site), places(site), toward, force_share, of_tendon))
            pieces.append(_Ends(geom_body, point, places(site), touches * force_share, of_tendon))
    return pieces


def _forces(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the force of each tendon along its length, [ntendon] (N); if positive, it pushes."""
    fields = jax_fields(data)
    # The spring is slack between the two lengths of ``tendon_lengthspring``.
    below, above = model.tendon_lengthspring.T - data.ten_length
    force = model.tendon_stiffness * (jnp.maximum(below, 0) + jnp.minimum(above, 0))
    force -= model.tendon_damping * fields.ten_velocity
    # The armature resists the length's second derivative, J qacc + dJ/dt qvel.
    acceleration = fields.ten_J @ data.qacc + mjx_internals.tendon_dot(model, data) @ data.qvel
    force -= model.tendon_armature * acceleration
    actuators = np.flatnonzero(model.actuator_trntype == mjx.TrnType.TENDON)
    actuator_force = model.actuator_gear[actuators, 0] * data.actuator_force[actuators]
    force = force.at[model.actuator_trnid[actuators, 0]].add(actuator_force)
    return _with_rows(model, data, force)


def _with_rows(model: mjx.Model, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Adds the forces of the constraint rows of tendons, the last ones of their kinds."""
    fields = jax_fields(data)
    efc_force = fields.efc_force
    equality_end, friction_end, limit_end = np.cumsum([fields.ne, fields.nf, fields.nl])
    equalities = np.flatnonzero(model.eq_type == mjx.EqType.TENDON)
    rough = np.flatnonzero(mjx_internals.has_friction(model))
    limited = np.flatnonzero(model.tendon_limited)
    if fields.ne and equalities.size:
        # The length of the first tendon is a polynomial of the second's: through its slope the row
        # pulls at the second. An equality of one tendon has -1 for the second.
        pull = efc_force[equality_end - equalities.size : equality_end]
        tendon1 = model.eq_obj1id[equalities]
        tendon2 = model.eq_obj2id[equalities]
        stretch = (data.ten_length - model.tendon_length0)[tendon2]
        coefficients = model.eq_data[equalities, 1:5] * np.arange(1, 5)
        slope = jnp.sum(coefficients * stretch[:, None] ** np.arange(4), axis=1)
        force = force.at[tendon1].add(pull)
        force = force.at[tendon2].add(jnp.where(tendon2 < 0, 0, -slope * pull))
    if fields.nf and rough.size:
        force = force.at[rough].add(efc_force[friction_end - rough.size : friction_end])
    if fields.nl and limited.size:
        # Of both limits MJX makes the row of the nearer one, which pushes away from it.
        below, above = (model.tendon_range.T - data.ten_length)[:, limited]
        sign = jnp.where(-below < above, 1, -1)
        force = force.at[limited].add(sign * efc_force[limit_end - limited.size : limit_end])
    return force
