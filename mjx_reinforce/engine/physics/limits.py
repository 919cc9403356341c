r"""Joint limits in closed form, where at most two of them share a kinematic tree.

MuJoCo's acceleration a minimizes

    (a - a_s)' M (a - a_s) / 2 + \sum_i D_i min(0, J_i a - r_i)^2 / 2

with the unconstrained acceleration a_s, the rows' Jacobian J, reference r and constraint mass D.
With f_i = D_i max(0, r_i - J_i a) the gradient vanishes where M (a - a_s) = J' f, so that f solves
a complementarity problem in A = J inv(M) J' and b = J a_s - r:

    f >= 0,   f_i = D_i max(0, -(b + A f)_i).

A + inv(D) is positive definite, so that exactly one set of active rows fits (at a tie, two sets
give the same forces). A limit's row is plus or minus one at its joint, or zero while the limit is
not reached.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics import impedance, inertia
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

_MAX_ROWS_TOGETHER = 2


def supports(model: mjx.Model, data: mjx.Data) -> bool:
    """Returns whether all rows are limits of scalar joints, at most two to a kinematic tree.

    ``nl`` counts the rows of limits, which a flag may disable, also those of balls and tendons.
    """
    impl = jax_fields(data)
    joints = _limited_joints(model)
    has_only_limits = impl.efc_J.shape[0] == impl.nl == joints.size
    return has_only_limits and max(map(len, _coupled_rows(model, joints))) <= _MAX_ROWS_TOGETHER


def past_limit(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Returns whether some joint is past its limit [], by the same test as MJX's rows."""
    joints = _limited_joints(model)
    position = data.qpos[np.asarray(model.jnt_qposadr)[joints]]
    low = model.jnt_range[joints, 0]
    high = model.jnt_range[joints, 1]
    distance = jnp.minimum(position - low, high - position) - model.jnt_margin[joints]
    # A NaN counts as reached, so that it gets to the acceleration as it does in MJX.
    return ~jnp.all(distance >= 0)


def solve_limits(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solves for the limits' forces exactly.

    Args:
      model: a model that ``supports`` accepts.
      data: its data after ``mjx.fwd_acceleration``.

    Returns:
      The acceleration [nv], the limits' joint forces [nv] and the rows' forces [rows].
    """
    # The rows are made again here, so that nothing outside this branch needs them.
    impl = jax_fields(impedance.make_constraint(model, data))
    joints = _limited_joints(model)
    dofs = np.asarray(model.jnt_dofadr)[joints]
    # A row's only entry: 1 at the lower limit, -1 at the upper one, 0 inside.
    sign = [impl.efc_J[i, dof] for i, dof in enumerate(dofs)]
    unit = jnp.eye(model.nv, dtype=data.qacc_smooth.dtype)
    # response[i] is inv(M) applied to row i, up to its sign.
    response = [inertia.inverse_times(model, data, unit[dof]) for dof in dofs]
    force: list[Any] = [None] * dofs.size
    for rows in _coupled_rows(model, joints):
        # D A and -D b of the module's docstring: f = max(0, target - matrix f).
        matrix = [
            [impl.efc_D[i] * sign[i] * sign[j] * response[i][dofs[j]] for j in rows] for i in rows
        ]
        target = [
            impl.efc_D[i] * (impl.efc_aref[i] - sign[i] * data.qacc_smooth[dofs[i]]) for i in rows
        ]
        for i, value in zip(rows, _complementary(matrix, target), strict=True):
            force[i] = value
    torque = [s * f for s, f in zip(sign, force, strict=True)]
    change = sum(t * r for t, r in zip(torque, response, strict=True))
    qfrc_constraint = jnp.zeros_like(data.qfrc_constraint).at[dofs].set(jnp.stack(torque))
    return data.qacc_smooth + change, qfrc_constraint, jnp.stack(force)


def _limited_joints(model: mjx.Model) -> np.ndarray:
    """Returns the limited slide and hinge joints, in the order of their rows."""
    is_scalar = np.isin(model.jnt_type, (mjx.JointType.SLIDE, mjx.JointType.HINGE))
    return np.flatnonzero(is_scalar & (np.asarray(model.jnt_limited) != 0))


def _coupled_rows(model: mjx.Model, joints: np.ndarray) -> list[list[int]]:
    """Groups rows by kinematic tree: the inertia matrix couples nothing across trees."""
    trees = np.asarray(model.body_rootid)[np.asarray(model.jnt_bodyid)[joints]]
    return [np.flatnonzero(trees == tree).tolist() for tree in np.unique(trees)] or [[]]


def _complementary(matrix: list[list[Any]], target: list[Any]) -> list[Any]:
    """Solves f = max(0, target - matrix f) for one or two unknowns.

    Each set of active rows gives one candidate; the one that is consistent is taken.
    """
    # With one row active, which is then as if it were alone, the other's force must be zero.
    forces1 = [jnp.maximum(target[i], 0) / (1 + matrix[i][i]) for i in range(len(target))]
    if len(target) == 1:
        return forces1
    (a, b), (c, d) = matrix
    is_first = target[1] - c * forces1[0] <= 0
    is_second = target[0] - b * forces1[1] <= 0
    # With both active they solve f + matrix f = target, by Cramer's rule.
    determinant = (1 + a) * (1 + d) - b * c
    forces2 = [
        ((1 + d) * target[0] - b * target[1]) / determinant,
        ((1 + a) * target[1] - c * target[0]) / determinant,
    ]
    return [
        jnp.where(is_first, forces1[0], jnp.where(is_second, 0, forces2[0])),
        jnp.where(is_first, 0, jnp.where(is_second, forces1[1], forces2[1])),
    ]
