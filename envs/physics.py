"""`mjx.step` with a constraint solver that costs next to nothing.

MJX's Newton solver is a loop around a line search that is another loop, in every forward pass,
also where no constraint is active. Two cases are cheaper and lead to the same answer:

- Where the only constraint rows are limits of slide and hinge joints, at most two of them to a
  kinematic tree, the optimum has a closed form: `_solve_limits`.
- Otherwise the solver is entered only if some row is active; without one, the acceleration is the
  unconstrained one: `_solve_if_active`.

Everything else is MJX's own stages in MJX's order. Solver options are untouched; the closed form
does not read `iterations` and `tolerance`, nor the warm start, because it is exact.
"""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import constraint, sensor, smooth, solver, types
from mujoco.mjx._src import forward as stages

_MAX_ROWS_TOGETHER = 2

# Runge-Kutta 4: where each later stage is evaluated, and what each stage counts.
_STAGE_POSITIONS = (0.5, 0.5, 1.0)
_STAGE_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advances the simulation by one timestep; equal to `mjx.step(model, data)`.

    Args:
        model: an MJX model made with impl='jax'.
        data: its data, with `ctrl` set.

    Raises:
        ValueError: if the model is not of MJX's JAX implementation.
        NotImplementedError: if MJX has no such integrator.
    """
    if model.impl != mjx.Impl.JAX:
        raise ValueError(f"physics.step needs mjx.put_model(model, impl='jax'), got {model.impl}")
    data = forward(model, data)
    integrator = model.opt.integrator
    if integrator == mjx.IntegratorType.RK4:
        return _runge_kutta_4(model, data)
    if integrator == mjx.IntegratorType.EULER:
        return stages.euler(model, data)
    if integrator == mjx.IntegratorType.IMPLICITFAST:
        return stages.implicit(model, data)
    raise NotImplementedError(f"MJX has no integrator {integrator}")


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes accelerations; equal to `mjx.forward(model, data)`."""
    data = stages.fwd_position(model, data)
    data = sensor.sensor_pos(model, data)
    data = stages.fwd_velocity(model, data)
    data = sensor.sensor_vel(model, data)
    data = stages.fwd_actuation(model, data)
    data = stages.fwd_acceleration(model, data)
    if _impl(data).efc_J.size == 0:  # MJX skips the acceleration sensors here too
        return data.replace(qacc=data.qacc_smooth)
    return sensor.sensor_acc(model, _solve(model, data))


def _impl(data: mjx.Data) -> types.DataJAX:
    """Returns the fields of the JAX implementation, which `step` insists on."""
    return cast(types.DataJAX, data._impl)


def _solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Finds the constraint forces and the acceleration."""
    joints = _limited_joints(model)
    groups = _coupled_rows(model, joints)
    if _impl(data).efc_J.shape[0] == joints.size and max(map(len, groups)) <= _MAX_ROWS_TOGETHER:
        reached, solve = _limit_reached(model, data, joints), _solve_limits
    elif _impl(data).ne or _impl(data).nf:  # rows that are always active
        return solver.solve(model, data)
    else:  # inactive rows have a Jacobian of zero
        reached, solve = jnp.any(_impl(data).efc_J != 0), _solve_any
    qacc, qfrc_constraint, efc_force = jax.lax.cond(
        reached,
        lambda: solve(model, data),
        lambda: (
            data.qacc_smooth,
            jnp.zeros_like(data.qfrc_constraint),
            jnp.zeros_like(_impl(data).efc_force),
        ),
    )
    solved = data.tree_replace(
        {"qacc": qacc, "qfrc_constraint": qfrc_constraint, "_impl.efc_force": efc_force}
    )
    return cast(mjx.Data, solved)  # flax types it as any PyTreeNode


def _solve_any(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """MJX's solver; returns acceleration, joint forces and row forces."""
    data = solver.solve(model, data)
    return data.qacc, data.qfrc_constraint, _impl(data).efc_force


def _limited_joints(model: mjx.Model) -> np.ndarray:
    """Returns the limited slide and hinge joints, in the order of their rows."""
    scalar = np.isin(model.jnt_type, (mjx.JointType.SLIDE, mjx.JointType.HINGE))
    return np.flatnonzero(scalar & (np.asarray(model.jnt_limited) != 0))


def _coupled_rows(model: mjx.Model, joints: np.ndarray) -> list[list[int]]:
    """Groups rows by kinematic tree: the inertia matrix couples nothing across trees."""
    trees = np.asarray(model.body_rootid)[np.asarray(model.jnt_bodyid)[joints]]
    return [np.flatnonzero(trees == tree).tolist() for tree in np.unique(trees)] or [[]]


def _limit_reached(model: mjx.Model, data: mjx.Data, joints: np.ndarray) -> jax.Array:
    """Tells whether some joint is past its limit, as MJX's rows do."""
    position = data.qpos[np.asarray(model.jnt_qposadr)[joints]]
    low, high = model.jnt_range[joints, 0], model.jnt_range[joints, 1]
    distance = jnp.minimum(position - low, high - position) - model.jnt_margin[joints]
    # A NaN is let in, so that it reaches the acceleration as it does in MJX.
    return ~jnp.all(distance >= 0)


def _solve_limits(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    r"""Solves for joint limits exactly; returns acceleration, joint forces and row forces.

    MuJoCo's acceleration a minimises

        (a - a_s)' M (a - a_s) / 2 + \sum_i D_i min(0, J_i a - r_i)^2 / 2

    with the unconstrained acceleration a_s and the reference r. With f_i = D_i max(0, r_i - J_i a)
    the gradient vanishes where M (a - a_s) = J' f, so that f solves a complementarity problem in
    A = J inv(M) J' and b = J a_s - r:

        f >= 0,   f_i = D_i max(0, -(b + A f)_i).

    A + inv(D) is positive definite, so that exactly one set of active rows fits, ties aside.
    A limit's row is plus or minus one at its joint, or zero while the limit is not reached.
    """
    # The rows are made again here, so that nothing outside this branch needs them.
    impl = _impl(constraint.make_constraint(model, data))
    joints = _limited_joints(model)
    dofs = np.asarray(model.jnt_dofadr)[joints]
    sign = [impl.efc_J[i, dof] for i, dof in enumerate(dofs)]
    unit = jnp.eye(model.nv, dtype=data.qacc_smooth.dtype)
    # reaction[i] = inv(M) applied to row i, but for its sign
    reaction = [smooth.solve_m(model, data, unit[dof]) for dof in dofs]
    force: list[Any] = [None] * dofs.size
    for rows in _coupled_rows(model, joints):
        matrix = [
            [impl.efc_D[i] * sign[i] * sign[j] * reaction[i][dofs[j]] for j in rows] for i in rows
        ]
        target = [
            impl.efc_D[i] * (impl.efc_aref[i] - sign[i] * data.qacc_smooth[dofs[i]]) for i in rows
        ]
        for i, value in zip(rows, _complementary(matrix, target), strict=True):
            force[i] = value
    torque = [s * f for s, f in zip(sign, force, strict=True)]
    push = sum(t * r for t, r in zip(torque, reaction, strict=True))
    qfrc_constraint = jnp.zeros_like(data.qfrc_constraint).at[dofs].set(jnp.stack(torque))
    return data.qacc_smooth + push, qfrc_constraint, jnp.stack(force)


def _complementary(matrix: list[list[Any]], target: list[Any]) -> list[Any]:
    """Solves f = max(0, target - matrix f) for one or two unknowns.

    Each set of active rows gives one candidate; the one that is consistent is taken.
    """
    alone = [jnp.maximum(target[i], 0) / (1 + matrix[i][i]) for i in range(len(target))]
    if len(target) == 1:
        return alone
    (a, b), (c, d) = matrix
    first_suffices = target[1] - c * alone[0] <= 0
    second_suffices = target[0] - b * alone[1] <= 0
    determinant = (1 + a) * (1 + d) - b * c
    both = [
        ((1 + d) * target[0] - b * target[1]) / determinant,
        ((1 + a) * target[1] - c * target[0]) / determinant,
    ]
    return [
        jnp.where(first_suffices, alone[0], jnp.where(second_suffices, 0, both[0])),
        jnp.where(first_suffices, 0, jnp.where(second_suffices, alone[1], both[1])),
    ]


def _runge_kutta_4(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """MJX's Runge-Kutta of order 4, through this module's `forward`."""
    start, stage, timestep = data, data, model.opt.timestep
    qvel, qacc, act_dot = (_STAGE_WEIGHTS[0] * x for x in (data.qvel, data.qacc, data.act_dot))
    for position, weight in zip(_STAGE_POSITIONS, _STAGE_WEIGHTS[1:], strict=True):
        advanced = start.replace(qacc=position * stage.qacc)
        advanced = stages._advance(
            model, advanced, position * stage.act_dot, advanced.qacc, position * stage.qvel
        )
        stage = stage.replace(
            qpos=advanced.qpos,
            qvel=advanced.qvel,
            act=start.act + position * stage.act_dot * timestep,
            time=start.time + position * timestep,
        )
        stage = forward(model, stage)
        qvel = qvel + weight * stage.qvel
        qacc = qacc + weight * stage.qacc
        act_dot = act_dot + weight * stage.act_dot
    end = stage.replace(qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time)
    return stages._advance(model, end, act_dot, qacc, qvel)
