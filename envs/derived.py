"""What MuJoCo derives from masses, inertias and gears, for a model that an episode draws.

C MuJoCo computes these constants at the pose ``qpos0``, in ``mj_setConst`` (engine_setconst.c).
What no drawn field changes, such as Jacobians of frames, C MuJoCo computes here too, when a program
is traced. The rest follows in JAX, at the start of an episode.
"""

import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics import inertia
from mjx_reinforce.engine.physics.mjx_internals import geom_pairs
from mjx_reinforce.envs.refusals import may_touch

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Fields of a model by their names.
Fields = dict[str, Any]
#: Those on which the inverse of the inertia matrix depends.
_INERTIAL = ("body_mass", "body_inertia", "body_ipos", "dof_armature")
#: Those of ``models.RANDOM`` from which something follows.
READ = (*_INERTIAL, "actuator_gear")
_SUBTREE_SENSORS = (_C.mjtSensor.mjSENS_SUBTREELINVEL, _C.mjtSensor.mjSENS_SUBTREEANGMOM)
_BODY_EQUALITIES = (_C.mjtEq.mjEQ_CONNECT, _C.mjtEq.mjEQ_WELD)
#: ``body_simple`` of a body that only slides; of such a body C leaves out the armature.
_SLIDES = 2


class _Pose(NamedTuple):
    """A model at ``qpos0``, as far as no drawn field changes it.

    data: C MuJoCo's simulation there.
    xmat: [nbody, 3, 3] the rotations of the bodies' frames.
    origins: [nbody, 3, nv] the Jacobian of the frames' origins.
    turns: [nbody, 3, nv] the Jacobian of the frames' rotations.
    tendons: [ntendon, nv] the Jacobian of the tendons' lengths.
    """

    data: Any
    xmat: np.ndarray
    origins: np.ndarray
    turns: np.ndarray
    tendons: np.ndarray


def constants(model: MjModel, episode: Fields) -> dict[str, jax.Array]:
    """Returns what follows from the fields that an episode draws, where MJX reads it.

    Entries that no constraint, muscle, sensor or camera reads are those of the model.

    Args:
      model: the compiled model.
      episode: what ``MujocoEnv.randomize`` returned: fields of the model by their names, and more.

    Returns:
      By its name, whatever of these changes: ``body_subtreemass`` [nbody] (kg), ``cam_poscom0``
      [ncam, 3] (m), ``actuator_acc0`` [nu] (m/s^2, rad/s^2), ``body_invweight0`` [nbody, 2] (1/kg,
      1/(kg m^2)), ``dof_invweight0`` [nv] and ``tendon_invweight0`` [ntendon].
    """
    if not any(name in episode for name in READ):
        return {}
    fields = {name: episode.get(name, getattr(model, name)) for name in READ}
    pose = _pose(model)
    derived: dict[str, jax.Array] = {}
    if "body_mass" in episode and np.isin(model.sensor_type, _SUBTREE_SENSORS).any():
        derived["body_subtreemass"] = _in_subtree(model) @ fields["body_mass"]
    is_tracking = model.cam_mode == _C.mjtCamLight.mjCAMLIGHT_TRACKCOM
    if is_tracking.any() and ("body_mass" in episode or "body_ipos" in episode):
        derived["cam_poscom0"] = _camera_places(model, pose, fields)
    has_inertia = any(name in episode for name in _INERTIAL)
    muscles = _muscles(model)
    if not has_inertia and not muscles.size:
        return derived

    centers = _centers(pose, fields)
    inverse = inertia.inverse(_matrix(model, pose, centers, fields))
    if muscles.size:
        moments = jnp.einsum(
            "mk,mkj->mj", fields["actuator_gear"][muscles], _moments(model, pose.data, muscles)
        )
        acceleration = jnp.linalg.norm(moments @ inverse, axis=1)
        derived["actuator_acc0"] = jnp.asarray(model.actuator_acc0).at[muscles].set(acceleration)
    if not has_inertia:
        return derived
    if bodies := _bodies_of_rows(model):
        derived["body_invweight0"] = _body_weights(
            model, np.array(bodies), centers, pose.turns, inverse, fields["body_mass"]
        )
    if _has_dof_rows(model):
        derived["dof_invweight0"] = _dof_weights(model, inverse, fields["body_mass"])
    if _has_tendon_rows(model):
        squares = jnp.einsum("ti,tj->tij", pose.tendons, pose.tendons)
        derived["tendon_invweight0"] = _traces(squares, inverse)
    return derived


def _muscles(model: MjModel) -> np.ndarray:
    """Returns the actuators that read ``actuator_acc0``."""
    has_gain = model.actuator_gaintype == _C.mjtGain.mjGAIN_MUSCLE
    has_bias = model.actuator_biastype == _C.mjtBias.mjBIAS_MUSCLE
    return np.flatnonzero(has_gain | has_bias)


def _bodies_of_rows(model: MjModel) -> list[int]:
    """Returns the bodies that move and whose ``body_invweight0`` a contact or an equality reads."""
    pairs = [pair[:2] for pair in geom_pairs(model)] if may_touch(model) else []
    bodies = {int(model.geom_bodyid[geom]) for pair in pairs for geom in pair}
    for number in np.flatnonzero(np.isin(model.eq_type, _BODY_EQUALITIES)):
        ends = np.array([model.eq_obj1id[number], model.eq_obj2id[number]])
        is_site = model.eq_objtype[number] == _C.mjtObj.mjOBJ_SITE
        bodies |= {*(model.site_bodyid[ends] if is_site else ends).tolist()}
    return sorted(body for body in bodies if model.body_dofnum[model.body_weldid[body]])


def _has_dof_rows(model: MjModel) -> bool:
    """Returns whether a limit, a friction loss or an equality of joints is there."""
    has_equality = np.any(model.eq_type == _C.mjtEq.mjEQ_JOINT)
    return bool(has_equality or np.any(model.jnt_limited) or np.any(model.dof_frictionloss))


def _has_tendon_rows(model: MjModel) -> bool:
    """Returns whether a limit, a friction loss or an equality of tendons is there."""
    has_equality = np.any(model.eq_type == _C.mjtEq.mjEQ_TENDON)
    return bool(has_equality or np.any(model.tendon_limited) or np.any(model.tendon_frictionloss))


def _pose(model: MjModel) -> _Pose:
    """Returns the model at ``qpos0``."""
    data = _C.MjData(model)
    for compute in (_C.mj_kinematics, _C.mj_comPos, _C.mj_tendon):
        compute(model, data)
    origins = np.zeros((model.nbody, 3, model.nv))
    turns = np.zeros_like(origins)
    for body in range(model.nbody):
        _C.mj_jacBody(model, data, origins[body], turns[body], body)
    tendons = np.zeros((model.ntendon, model.nv))
    if model.ntendon:
        _C.mju_sparse2dense(
            tendons, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
        )
    return _Pose(data, data.xmat.reshape(-1, 3, 3), origins, turns, tendons)


def _moments(model: MjModel, data: Any, actuators: np.ndarray) -> np.ndarray:
    """Returns the moments at ``qpos0`` by each entry of gear, [M, 6, nv]; they are linear in it."""
    geared = copy.copy(model)
    moments = np.zeros((6, model.nu, model.nv))
    for entry in range(6):
        geared.actuator_gear[:] = np.eye(6)[entry]
        _C.mj_transmission(geared, data)
        _C.mju_sparse2dense(
            moments[entry],
            data.actuator_moment,
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind,
        )
    return np.moveaxis(moments, 0, 1)[actuators]


def _centers(pose: _Pose, fields: Fields) -> jax.Array:
    """Returns the Jacobian of the centers of mass, [nbody, 3, nv]."""
    arms = jnp.einsum("bxk,bk->bx", pose.xmat, fields["body_ipos"])
    return jnp.cross(pose.turns, arms[:, :, None], axis=1) + pose.origins


def _matrix(model: MjModel, pose: _Pose, centers: jax.Array, fields: Fields) -> jax.Array:
    """Returns the inertia matrix at ``qpos0``, [nv, nv]."""
    axes = pose.data.ximat.reshape(-1, 3, 3)
    turns = np.einsum("bxk,bxi->bki", axes, pose.turns)
    inertias = np.einsum("bki,bkj->bkij", turns, turns)
    armature = pose.tendons.T @ (model.tendon_armature[:, None] * pose.tendons)
    matrix = jnp.diag(jnp.asarray(fields["dof_armature"]))
    matrix += jnp.einsum("b,bij->ij", fields["body_mass"], _squares(centers))
    matrix += jnp.einsum("bk,bkij->ij", fields["body_inertia"], inertias)
    return matrix + jnp.where(inertia.coupled(model), armature, 0)


def _squares(jacobian: Any) -> jax.Array:
    """Returns J' J of the Jacobians of points, [N, 3, nv] to [N, nv, nv]."""
    return jnp.einsum("nxi,nxj->nij", jacobian, jacobian)


def _traces(squares: jax.Array, inverse: jax.Array) -> jax.Array:
    """Returns the traces of J inv(M) J', [N], from J' J [N, nv, nv]."""
    # Both are symmetric: the lower triangle is enough, and the upper one is then never computed.
    lower = jnp.tril(squares) + jnp.tril(squares, -1)
    return jnp.einsum("nij,ij->n", lower, inverse)


def _body_weights(
    model: MjModel,
    bodies: np.ndarray,
    centers: jax.Array,
    turns: np.ndarray,
    inverse: jax.Array,
    mass: jax.Array,
) -> jax.Array:
    """Returns ``body_invweight0`` [nbody, 2]: of the translation and the rotation, means of three.

    Args:
      model: the model.
      bodies: whose weights are computed.
      centers: [nbody, 3, nv] the Jacobian of the centers of mass.
      turns: [nbody, 3, nv] the Jacobian of the rotations.
      inverse: [nv, nv] of the inertia matrix.
      mass: [nbody] of the bodies (kg).
    """
    weights = jnp.stack(
        [_traces(_squares(jacobian[bodies]), inverse) / 3 for jacobian in (centers, turns)], 1
    )
    slides = (model.body_simple[bodies] == _SLIDES)[:, None]
    weights = jnp.where(slides, jnp.stack([1 / mass[bodies], 0 * mass[bodies]], 1), weights)
    return jnp.asarray(model.body_invweight0, weights.dtype).at[bodies].set(weights)


def _dof_weights(model: MjModel, inverse: jax.Array, mass: jax.Array) -> jax.Array:
    """Returns ``dof_invweight0`` [nv]: means of three for what slides or turns in space."""
    # Neighbors share a mean if they belong to one joint and, in a free one, to the same half.
    kind = model.jnt_type[model.dof_jntid]
    offset = np.arange(model.nv) - model.jnt_dofadr[model.dof_jntid]
    half = (kind == _C.mjtJoint.mjJNT_FREE) & (offset >= 3)
    group = 2 * model.dof_jntid + half
    is_shared = group[:, None] == group
    weights = (is_shared / is_shared.sum(1)) @ jnp.diagonal(inverse)
    body = model.dof_bodyid
    return jnp.where(model.body_simple[body] == _SLIDES, 1 / mass[body], weights)


def _in_subtree(model: MjModel) -> np.ndarray:
    """Returns whether body j is in the subtree of body i, [nbody, nbody]."""
    in_subtree = np.eye(model.nbody)
    # From the leaves to the root: a parent's number is below those of its children.
    for body in range(model.nbody - 1, 0, -1):
        in_subtree[model.body_parentid[body]] += in_subtree[body]
    return in_subtree


def _camera_places(model: MjModel, pose: _Pose, fields: Fields) -> jax.Array:
    """Returns where cameras are from the center of mass of what they track, [ncam, 3] (m)."""
    in_subtree = _in_subtree(model)
    mass = fields["body_mass"]
    centers = pose.data.xpos + jnp.einsum("bxk,bk->bx", pose.xmat, fields["body_ipos"])
    target = np.where(model.cam_targetbodyid < 0, model.cam_bodyid, model.cam_targetbodyid)
    center = (in_subtree @ (mass[:, None] * centers)) / (in_subtree @ mass)[:, None]
    return model.cam_pos0 + pose.data.xpos[model.cam_bodyid] - center[target]
