"""Solves with the inertia matrix, from the leaves of the kinematic tree to its root.

The matrix has zeros where no path from the root holds both degrees of freedom. MJX eliminates the
root's degrees of freedom first, which fills these zeros. From the leaves on they stay zeros
(Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.5; ``mj_factorI`` of C MuJoCo), and
``scalar`` writes nothing for them: of the 4,190 operations of Humanoid's factor 1,763 are left.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics import mjx_internals
from mjx_reinforce.engine.physics.mjx_internals import advance, jax_fields, with_fields
from mjx_reinforce.engine.scalar import is_written_out


def tendon_armature(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Adds the armature of tendons, as ``mjx.tendon_armature``.

    As in C, it does not couple degrees of freedom of two branches of a tree.
    """
    data = mjx.tendon_armature(model, data)
    matrix = jax_fields(data).M
    if matrix.ndim == 1 or not model.ntendon:  # a sparse one has no place for it
        return data
    return with_fields(data, M=jnp.where(coupled(model), matrix, 0))


def coupled(model: Any) -> np.ndarray:
    """Returns where C's inertia matrix has entries, [nv, nv].

    Args:
      model: an ``MjModel`` or an ``mjx.Model``.
    """
    # Compressed rows of the lower triangle, as mjData keeps ``M``.
    lower = np.zeros((model.nv, model.nv), bool)
    lower[np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind] = True
    return lower | lower.T


def inverse_times(model: mjx.Model, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Returns inv(M) force, [nv].

    Args:
      model: an MJX model made with impl='jax'.
      data: its data after ``mjx.factor_m``.
      force: [nv]
    """
    if not is_written_out():
        return mjx_internals.solve_m(model, data, force)
    return _from_leaves(mjx.full_m(model, data), force)


def fwd_acceleration(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes the acceleration without constraints, as ``mjx.fwd_acceleration``."""
    data = mjx.fwd_acceleration(model, data)
    if not is_written_out():
        return data
    return data.replace(qacc_smooth=inverse_times(model, data, data.qfrc_smooth))


def euler(model: mjx.Model, data: mjx.Data, balanced: bool = True) -> mjx.Data:
    """Advances by one timestep with damping at the step's end, as ``mjx.euler``.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data after the forward pass.
      balanced: whether the acceleration is that of the forces. Where it is not, C takes the forces
        if a degree of freedom is damped, and the acceleration otherwise.
    """
    if model.opt.disableflags & mjx.DisableBit.EULERDAMP:
        return mjx.euler(model, data)

    # ``mj_EulerSkip``: damping at the step's end makes the matrix M + h diag(B).
    damped_mass = mjx.full_m(model, data) + jnp.diag(model.opt.timestep * model.dof_damping)
    force = data.qfrc_smooth + data.qfrc_constraint

    qacc = solve(damped_mass, force)
    if not balanced:
        qacc = jnp.where(jnp.any(model.dof_damping > 0), qacc, data.qacc)
    return advance(model, data, data.act_dot, qacc)


def implicitfast(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advances by one timestep, implicit in velocity, as ``mj_implicit`` of C MuJoCo 4.0.

    The forces of actuators and dampers are those of the velocity at the step's end; for a body that
    flies freely (``_free_bodies``) so is ``qfrc_bias``. Of other bodies C leaves out what the
    derivative has where the inertia matrix has nothing.
    """
    # M - h dF/dv, for ``mjINT_IMPLICITFAST`` symmetric: without the derivative of ``qfrc_bias``.
    timestep = model.opt.timestep
    change = timestep * _velocity_derivative(model, data)
    force = data.qfrc_smooth + data.qfrc_constraint
    inertia = mjx.full_m(model, data)
    qacc = solve(inertia - jnp.where(coupled(model), change, 0), force)
    # A free body shares no entry with others: its six rows are solved again, with its gyroscopic
    # forces, which make them unsymmetric.
    for body in _free_bodies(model):
        dofs = np.flatnonzero(model.dof_bodyid == body)
        block = (inertia - change)[dofs[:, None], dofs]
        block = block.at[:, 3:].add(timestep * _bias_derivative(model, data, body, dofs))
        qacc = qacc.at[dofs].set(_solve_in_halves(block, force[dofs]))

    return advance(model, data, data.act_dot, qacc)


def _velocity_derivative(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns the derivative of the actuators' and dampers' forces by velocity, [nv, nv]."""
    # ``mjd_passive_vel``: of joints and tendons.
    impl = jax_fields(data)
    damping = (impl.ten_J.T * model.tendon_damping) @ impl.ten_J
    derivative = -jnp.diag(model.dof_damping) - damping
    if model.opt.disableflags & mjx.DisableBit.ACTUATION:
        return derivative

    # ``mjd_actuator_vel``: a force is gain * signal + bias, of which both may depend on velocity.
    is_affine = model.actuator_gaintype == mjx.GainType.AFFINE
    gain = jnp.where(is_affine, model.actuator_gainprm[:, 2], 0)
    muscles = np.flatnonzero(model.actuator_gaintype == mjx.GainType.MUSCLE)
    if muscles.size:
        muscle_gain = jax.vmap(jax.grad(mjx_internals.muscle_gain, argnums=1))(
            data.actuator_length[muscles],
            impl.actuator_velocity[muscles],
            jnp.asarray(model.actuator_lengthrange)[muscles],
            jnp.asarray(model.actuator_acc0)[muscles],
            model.actuator_gainprm[muscles],
        )
        gain = gain.at[muscles].set(muscle_gain)
    # The signal is the activation where an actuator has one: the last of its own.
    signal = data.ctrl
    if not model.opt.disableflags & mjx.DisableBit.CLAMPCTRL:
        is_limited = jnp.asarray(model.actuator_ctrllimited) != 0
        signal = jnp.where(is_limited, jnp.clip(signal, *model.actuator_ctrlrange.T), signal)
    if model.na:
        last_act = model.actuator_actadr + model.actuator_actnum - 1
        signal = jnp.where(model.actuator_actadr == -1, signal, data.act[last_act])
    is_affine = model.actuator_biastype == mjx.BiasType.AFFINE
    force_rate = gain * signal + jnp.where(is_affine, model.actuator_biasprm[:, 2], 0)
    # A force at an end of its range does not change with velocity; MJX counts it all the same.
    force_rate = jnp.where(_clamped(model, data), 0, force_rate)
    return derivative + (impl.actuator_moment.T * force_rate) @ impl.actuator_moment


def _clamped(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns which actuators [nu] C takes for constant, since a force is at an end of its range.

    That is an actuator's own force, or what all actuators of its joint or its tendon add up to. For
    other transmissions the ranges of the joints that they move do not count.
    """

    def at_end(
        force: jax.Array, is_limited: np.ndarray, ranges: jax.Array, slack: float = 0
    ) -> jax.Array:
        """Returns which forces are at an end of their range, by a share of it as slack."""
        low, high = ranges.T
        is_outside = (force <= low + slack * jnp.abs(low)) | (force >= high - slack * jnp.abs(high))
        return is_outside & (jnp.asarray(is_limited) != 0)

    # Which joint, [nu, njnt], or tendon, [nu, ntendon], an actuator moves.
    force = data.actuator_force
    trntype = model.actuator_trntype
    target = model.actuator_trnid[:, :1]
    is_joint = np.isin(trntype, (mjx.TrnType.JOINT, mjx.TrnType.JOINTINPARENT))[:, None]
    joint_mask = is_joint & (target == np.arange(model.njnt))
    tendon_mask = (trntype == mjx.TrnType.TENDON)[:, None] & (target == np.arange(model.ntendon))
    joint_force = data.qfrc_actuator[model.jnt_dofadr]
    # A tendon's forces are scaled to its limit, and their sum is rounded.
    rounding = max(1e-10, 10 * float(jnp.finfo(force.dtype).eps))
    actuator_at_end = at_end(force, model.actuator_forcelimited, model.actuator_forcerange)
    joint_at_end = at_end(joint_force, model.jnt_actfrclimited, model.jnt_actfrcrange)
    tendon_at_end = tendon_mask & at_end(
        force @ tendon_mask, model.tendon_actfrclimited, model.tendon_actfrcrange, rounding
    )
    return actuator_at_end | (joint_mask & joint_at_end).any(1) | tendon_at_end.any(1)


def _free_bodies(model: mjx.Model) -> list[int]:
    """Returns the bodies whose free joint is alone in their tree; others may be fixed to them."""
    is_single_body = np.bincount(model.dof_treeid) == 6
    dofadr = model.jnt_dofadr[model.jnt_type == mjx.JointType.FREE]
    return model.dof_bodyid[dofadr[is_single_body[model.dof_treeid[dofadr]]]].tolist()


def _bias_derivative(model: mjx.Model, data: mjx.Data, body: int, dofs: np.ndarray) -> jax.Array:
    """Returns the derivative of a free body's ``qfrc_bias`` by its turning, [6, 3]."""
    # With all that is fixed to it, about the center of mass: ``crb`` has six entries of the
    # inertia, three of mass times offset, and the mass.
    inertia = jax_fields(data).crb[body][np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]
    frame = data.xmat[body].reshape(3, 3)
    arm = data.subtree_com[body] - data.xpos[body]

    def bias(velocity: jax.Array) -> jax.Array:
        """Returns the centrifugal force in the world, and the torque in the body's frame, [6]."""
        spin = frame @ velocity
        push = jax_fields(data).crb[body, 9] * jnp.cross(spin, jnp.cross(spin, arm))
        torque = jnp.cross(arm, push) + jnp.cross(spin, inertia @ spin)
        return jnp.concatenate([push, frame.T @ torque])

    return jax.jacfwd(bias)(data.qvel[dofs[3:]])


def _solve_in_halves(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """Returns inv(matrix) rhs, [6], for a matrix [6, 6] whose first half is positive definite."""
    # The first half is eliminated as a block: the second is left with its Schur complement.
    inverse = _inverse(matrix[:3, :3])
    ratio = matrix[3:, :3] @ inverse
    lower = _inverse(matrix[3:, 3:] - ratio @ matrix[:3, 3:]) @ (rhs[3:] - ratio @ rhs[:3])
    return jnp.concatenate([inverse @ (rhs[:3] - matrix[:3, 3:] @ lower), lower])


def _inverse(matrix: jax.Array) -> jax.Array:
    """Returns the inverse [3, 3] by Cramer's rule."""
    a, b, c = matrix
    columns = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return columns / jnp.dot(a, columns[:, 0])


def solve(matrix: jax.Array, force: jax.Array) -> jax.Array:
    """Returns inv(matrix) force, [nv], for an inertia matrix to which a positive one was added."""
    if is_written_out():
        return _from_leaves(matrix, force)
    return _from_root(matrix, force)  # as MJX, where its matrices are dense


def inverse(matrix: jax.Array) -> jax.Array:
    """Returns the inverse of an inertia matrix, [nv, nv]."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def _from_leaves(inertia: jax.Array, force: jax.Array) -> jax.Array:
    """Solves; the degrees of freedom [nv] of a body come after those of its parent."""
    # Backwards, Cholesky's factor has entries only where the matrix has, and zeros are skipped.
    return _from_root(inertia[::-1, ::-1], force[::-1])[::-1]


def _from_root(inertia: jax.Array, force: jax.Array) -> jax.Array:
    factor = jax.scipy.linalg.cho_factor(inertia, lower=True)
    return jax.scipy.linalg.cho_solve(factor, force)
