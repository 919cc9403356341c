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
    point, far_point: [N, 3] the end, and the other one (m).
    share: [N] of the tendon's force; 0 if there is no such piece.
    tendon: [N]
    """

    body: np.ndarray
    point: jax.Array
    far_point: jax.Array
    share: jax.Array | np.ndarray
    tendon: np.ndarray


#: How pieces' fields are put together: what is known of the model alone stays so.
_CONCATENATES = np.concatenate, *[jnp.concatenate] * 3, np.concatenate


def body_forces(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the force, and the torque about ``xipos``, of tendons on bodies, [nbody, 6] (N, Nm).

    Args:
      model: an MJX model with a spatial tendon.
      data: its data after the constraints were solved.
    """
    columns = zip(_CONCATENATES, zip(*_pieces(model, data), strict=True), strict=True)
    stacks: list[Any] = [concatenate(column) for concatenate, column in columns]
    ends = _Ends(*stacks)
    # As ``mju_normalize3``: a piece without length points along x.
    axis = ends.point - ends.far_point
    length = jnp.linalg.norm(axis, axis=1, keepdims=True)
    axis = jnp.where(length < mjMINVAL, jnp.eye(3)[0], axis / jnp.maximum(length, mjMINVAL))
    force = (_forces(model, data)[ends.tendon] * ends.share)[:, None] * axis
    torque = jnp.cross(ends.point - data.xipos[ends.body], force)
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
    starts = np.flatnonzero(is_site[:-1] & is_site[1:] & (tendon[:-1] == tendon[1:]))
    wraps = np.flatnonzero(np.isin(model.wrap_type, _GEOMS))
    share = 1 / np.maximum(divisor, mjMINVAL)

    def bodies(elements: np.ndarray) -> np.ndarray:
        return model.site_bodyid[model.wrap_objid[elements]]

    def places(elements: np.ndarray) -> jax.Array:
        return data.site_xpos[model.wrap_objid[elements]]

    pieces = [
        _Ends(bodies(i), places(i), places(j), share[i], tendon[i])
        for i, j in ((starts, starts + 1), (starts + 1, starts))
    ]
    if wraps.size:
        # From each site to where the tendon meets the geom; where it misses the geom, to the site
        # on the other side. The geom's body is pulled where the tendon meets it.
        is_wrap, *points = mjx_internals.wrap_points(model, data, wraps)
        geom_body = model.geom_bodyid[model.wrap_objid[wraps]]
        for step, point in zip((-1, 1), points, strict=True):
            site = wraps + step
            far_site = wraps - step
            force_share = share[wraps]
            tendon_id = tendon[wraps]
            far_point = jnp.where(is_wrap[:, None], point, places(far_site))
            pieces.append(_Ends(bodies(site), places(site), far_point, force_share, tendon_id))
            pieces.append(_Ends(geom_body, point, places(site), is_wrap * force_share, tendon_id))
    return pieces


def _forces(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the force of each tendon along its length, [ntendon] (N); if positive, it pushes."""
    impl = jax_fields(data)
    # The spring is slack between the two lengths of ``tendon_lengthspring``.
    shortfall, excess = model.tendon_lengthspring.T - data.ten_length
    force = model.tendon_stiffness * (jnp.maximum(shortfall, 0) + jnp.minimum(excess, 0))
    force -= model.tendon_damping * impl.ten_velocity
    # The armature resists the length's second derivative, J qacc + dJ/dt qvel.
    acceleration = impl.ten_J @ data.qacc + mjx_internals.tendon_dot(model, data) @ data.qvel
    force -= model.tendon_armature * acceleration
    actuators = np.flatnonzero(model.actuator_trntype == mjx.TrnType.TENDON)
    actuator_force = model.actuator_gear[actuators, 0] * data.actuator_force[actuators]
    force = force.at[model.actuator_trnid[actuators, 0]].add(actuator_force)
    return _with_rows(model, data, force)


def _with_rows(model: mjx.Model, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Adds the forces of the constraint rows of tendons, the last ones of their kinds."""
    impl = jax_fields(data)
    efc_force = impl.efc_force
    equality_end, friction_end, limit_end = np.cumsum([impl.ne, impl.nf, impl.nl])
    equalities = np.flatnonzero(model.eq_type == mjx.EqType.TENDON)
    friction = np.flatnonzero(mjx_internals.has_friction(model))
    limits = np.flatnonzero(model.tendon_limited)
    if impl.ne and equalities.size:
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
    if impl.nf and friction.size:
        force = force.at[friction].add(efc_force[friction_end - friction.size : friction_end])
    if impl.nl and limits.size:
        # Of both limits MJX makes the row of the nearer one, which pushes away from it.
        lower_gap, upper_gap = (model.tendon_range.T - data.ten_length)[:, limits]
        sign = jnp.where(-lower_gap < upper_gap, 1, -1)
        force = force.at[limits].add(sign * efc_force[limit_end - limits.size : limit_end])
    return force
