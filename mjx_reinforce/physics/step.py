"""C MuJoCo's step in MJX, with constraint solvers that do no needless work.

MJX's Newton solver is a loop around a line search that is another loop, in every forward pass,
also where no constraint is active. Two cases are cheaper and lead to the same answer:

- Where the only constraint rows are limits of slide and hinge joints, at most two of them to a
  kinematic tree, the optimum has a closed form: `_solve_limits`.
- Otherwise the solver is entered only if some row is active (under `jax.vmap` it always is);
  without one, the acceleration is the unconstrained one: `_solve`. For all of Gymnasium's tasks
  with contacts it is `newton`, whose line search is exact; MJX's own remains for elliptic cones,
  friction loss and conjugate gradients.

Everything else is MJX's own stages in MJX's order, but for two places in which MJX 3.17 departs
from C MuJoCo 4.0, which Gymnasium runs, and in which the answer here is C's:

- Runge-Kutta on the orientations of free and ball joints: `_runge_kutta_4`.
- Contacts of capsules: `contacts`.

With neither, as in InvertedPendulum, a step is equal to `mjx.step`. Solver options are untouched;
the closed form does not read `iterations` and `tolerance`, nor the warm start, because it is exact.
C's Newton solver stops at a small gradient or a small improvement, `newton` only at the optimum or
a step too small to count, so that ours now and then takes an iteration more, nearer to the optimum.
"""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import constraint, sensor, smooth, solver, types
from mujoco.mjx._src import forward as stages

from mjx_reinforce.physics import contacts, newton

_MAX_ROWS_TOGETHER = 2

# Runge-Kutta 4: where each stage is in the timestep, what it counts, and where the next one is.
_STAGES = ((0, 1 / 6, 0.5), (0.5, 1 / 3, 0.5), (0.5, 1 / 3, 1), (1, 1 / 6, 0))

# Below this square of an angle a series in it replaces the closed form in `_rotation_rate`.
_SMALL_SQUARE = 0.01
_BORTZ_SERIES = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600)

Forward = Callable[[mjx.Data], mjx.Data]


def step(model: mjx.Model, data: mjx.Data, evaluate: Forward | None = None) -> mjx.Data:
    """Advances the simulation by one timestep, as `mj_step` of C MuJoCo 4.0.

    Equal to `mjx.step(model, data)` where the model has no contacts of capsules and, if its
    integrator is Runge-Kutta, no free or ball joints.

    Args:
        model: an MJX model made with impl='jax'.
        data: its data, with `ctrl` set.
        evaluate: `forward` of this model, where the caller has it jitted.

    Raises:
        ValueError: if the model is not of MJX's JAX implementation.
        NotImplementedError: if MJX has no such integrator.
    """
    if model.impl != mjx.Impl.JAX:
        raise ValueError(f"physics.step needs mjx.put_model(model, impl='jax'), got {model.impl}")
    # The model stays constant, so that it folds.
    evaluate = evaluate or jax.jit(functools.partial(forward, model))
    integrator = model.opt.integrator
    if integrator == mjx.IntegratorType.RK4:
        return _runge_kutta_4(model, data, evaluate)
    data = evaluate(data)
    if integrator == mjx.IntegratorType.EULER:
        return stages.euler(model, data)
    if integrator == mjx.IntegratorType.IMPLICITFAST:
        return stages.implicit(model, data)
    raise NotImplementedError(f"MJX has no integrator {integrator}")


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes accelerations; equal to `mjx.forward(model, data)` but for contacts of capsules."""
    data = contacts.fwd_position(model, data)
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
        reached, solve = jnp.array(True), _solve_any
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
    """Newton's method, or MJX's solver; returns acceleration, joint forces and row forces."""
    if newton.supports(model, data):
        return newton.solve(model, data)
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


def _runge_kutta_4(model: mjx.Model, data: mjx.Data, evaluate: Forward) -> mjx.Data:
    """Runge-Kutta of order 4 as `mj_RungeKutta` of MuJoCo 4.0, with this module's `forward`.

    It is MJX's, but for the orientations of free and ball joints. MJX averages the stages' angular
    velocities, though each is in its own stage's frame; MuJoCo, from 4.0 on, averages the rates of
    one rotation vector (Runge-Kutta-Munthe-Kaas), without which the order is 2.
    """
    start, timestep = data, model.opt.timestep

    def follow(carry: tuple, row: jax.Array) -> tuple[tuple, None]:
        """Evaluates a stage, adds what it counts, and moves from the start to the next stage."""
        stage, rate, sums = carry
        position, weight, next_position = row
        stage = like(evaluate(stage), stage)
        rate = _displacement_rate(model, stage.qvel, rate, position)
        rates = rate, stage.qacc, stage.act_dot
        sums = tuple(total + weight * x for total, x in zip(sums, rates, strict=True))
        qvel, qacc, act_dot = (next_position * x for x in rates)
        advanced = stages._advance(model, start.replace(qacc=qacc), act_dot, qacc, qvel)
        stage = stage.replace(
            qpos=advanced.qpos,
            qvel=advanced.qvel,
            act=start.act + act_dot * timestep,
            time=start.time + next_position * timestep,
        )
        return (stage, rate, sums), None

    # A loop: one forward pass to compile, not four.
    nothing = jax.tree.map(jnp.zeros_like, (data.qvel, data.qvel, data.act))
    rows = jnp.asarray(_STAGES, data.qpos.dtype)
    (stage, _, sums), _ = jax.lax.scan(follow, (data, data.qvel, nothing), rows)
    end = stage.replace(qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time)
    qvel, qacc, act_dot = sums
    return stages._advance(model, end, act_dot, qacc, qvel)


def like(new: mjx.Data, old: mjx.Data) -> mjx.Data:
    """Returns new data in the old one's types; MJX makes tendon indices int64 under x64."""
    return jax.tree.map(lambda x, y: x.astype(y.dtype), new, old)


def _displacement_rate(
    model: mjx.Model, qvel: jax.Array, last_rate: jax.Array, position: jax.Array
) -> jax.Array:
    """Returns how fast the displacement since the step's start grows at a stage, [nv].

    Args:
        model: an MJX model; without free and ball joints, the answer is `qvel`.
        qvel: [nv] the stage's velocity.
        last_rate: [nv] the rate that led to the stage.
        position: [] the stage's place in the timestep, from 0 to 1.
    """
    rate = qvel
    for kind, dof in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if kind not in (mjx.JointType.FREE, mjx.JointType.BALL):
            continue
        first = int(dof) + (3 if kind == mjx.JointType.FREE else 0)
        turn = slice(first, first + 3)
        rotation = position * model.opt.timestep * last_rate[turn]
        rate = rate.at[turn].set(_rotation_rate(rotation, qvel[turn]))
    return rate


def _rotation_rate(rotation: jax.Array, velocity: jax.Array) -> jax.Array:
    r"""Returns the time derivative of a rotation vector r under angular velocity w, [3].

    Bortz (1971), with w in the rotated frame; `mju_derivExpmap` of MuJoCo 4.0:

        r' = w + r x w / 2 + c(|r|) r x (r x w),   c(x) = (1 - (x/2) cot(x/2)) / x^2

    c is singular at multiples of 2 pi, so that r is first replaced by the same rotation of an
    angle in (-pi, pi].
    """
    square = jnp.sum(rotation**2)
    large = square > jnp.pi**2
    angle = jnp.sqrt(jnp.where(large, square, 1))
    excess = 2 * jnp.pi * jnp.floor(angle / (2 * jnp.pi) + 0.5)
    rotation = jnp.where(large, rotation * (1 - excess / angle), rotation)
    square = jnp.sum(rotation**2)
    small = square < _SMALL_SQUARE
    safe = jnp.where(small, 1, square)
    half = jnp.sqrt(safe) / 2
    series = sum(c * square**i for i, c in enumerate(_BORTZ_SERIES))
    coefficient = jnp.where(small, series, (1 - half / jnp.tan(half)) / safe)
    across = jnp.cross(rotation, velocity)
    return velocity + across / 2 + coefficient * jnp.cross(rotation, across)
