"""C MuJoCo's step in MJX, with constraint solvers that do less work for the same answer.

The stages are MJX's own, in MJX's order, with seven exceptions:

- ``solve_constraints`` finds the constraint forces in closed form, or not at all where no
  constraint is active, or with a line search that ends when it is exact.
- ``contacts`` finds the contacts of capsules as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``runge_kutta_4`` turns free and ball joints as C MuJoCo 4.0 does: it averages the rates of one
  rotation vector (Runge-Kutta-Munthe-Kaas). MJX 3.17 averages the stages' angular velocities,
  though each is in its own stage's frame, which makes it a method of order 2.
- ``inertia.implicitfast`` leaves actuators at a limit out of the derivative by velocity and adds
  the turning of free bodies, as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``inertia.tendon_armature`` couples no branches of a tree, as C MuJoCo 4.0 does not.
- ``inertia`` solves from the leaves of the kinematic tree to its root, where it is written out.
- ``forward`` computes the sensors of accelerations without constraints too, where MJX skips them,
  and ``sensors`` has the forces that MJX leaves out.

Gymnasium runs C MuJoCo, so its answer is the one we want. For a model without such contacts,
joints and ``implicitfast``, such as InvertedPendulum's, a step equals ``mjx.step``.

MJX's Newton solver is a loop around a line search that is another loop, in every forward pass,
also where no constraint is active. Two cases are cheaper and lead to the same answer:

- Where the only constraint rows are limits of slide and hinge joints, at most two of them to a
  kinematic tree, the optimum has a closed form: ``limits``.
- Otherwise the solver is entered only if some row is active; if none is, the acceleration is the
  unconstrained one. (Under ``jax.vmap`` both branches are computed for every episode.) For all of
  Gymnasium's tasks with contacts the solver is ``newton``, whose line search is exact; MJX's own
  remains for elliptic cones and conjugate gradients.

A file that allows its solver few iterations has neither: ``early_stop`` ends where C ends.

The model's solver options stay as they are. The closed form is exact and reads none of
``iterations``, ``tolerance`` and the warm start. C's Newton solver also stops at a small gradient
or a small improvement, ``newton`` only at the optimum or at a step too small to count: now and then
it makes one iteration more than C, and ends nearer to the optimum.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.engine.physics import (
    contacts,
    early_stop,
    inertia,
    limits,
    newton,
    sensors,
    touching,
)
from mjx_reinforce.engine.physics.mjx_internals import advance, jax_fields, with_fields

# For each stage: its place in the timestep, its weight, and the place of the next stage.
_STAGES = ((0, 1 / 6, 0.5), (0.5, 1 / 3, 0.5), (0.5, 1 / 3, 1), (1, 1 / 6, 0))

# Below this square of an angle a series in it replaces the closed form in ``_rotation_rate``.
_SMALL_SQUARE = 0.01
_BORTZ_SERIES = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600)


def step(
    model: mjx.Model, data: mjx.Data, evaluate: Callable[[mjx.Data], mjx.Data] | None = None
) -> mjx.Data:
    """Advances the simulation by one timestep, as ``mj_step`` of C MuJoCo 4.0.

    Equal to ``mjx.step(model, data)`` where the model has no contacts of capsules and, if its
    integrator is Runge-Kutta, no free or ball joints; ``implicitfast`` is C's own.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data, with ``ctrl`` set.
      evaluate: ``forward`` of this model, where the caller has it jitted.

    Raises:
      ValueError: if the model is not of MJX's JAX implementation.
      NotImplementedError: if MJX has no such integrator.
    """
    if model.impl != mjx.Impl.JAX:
        raise ValueError(f"physics.step needs mjx.put_model(model, impl='jax'), got {model.impl}")
    # The model is bound, not passed, so that XLA sees constants and folds them.
    evaluate = evaluate or jax.jit(functools.partial(forward, model))
    integrator = model.opt.integrator
    if integrator == mjx.IntegratorType.RK4:
        return runge_kutta_4(model, data, evaluate)
    data = evaluate(data)
    if integrator == mjx.IntegratorType.EULER:
        # A solver that stops before the optimum leaves forces that do not give ``qacc``.
        return inertia.euler(model, data, balanced=not early_stop.stops_early(model))
    if integrator == mjx.IntegratorType.IMPLICITFAST:
        return inertia.implicitfast(model, data)
    raise NotImplementedError(f"MJX has no integrator {integrator}")


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes accelerations as ``mjx.forward(model, data)``, except for what this file lists."""
    data = contacts.fwd_position(model, data)
    data = mjx.sensor_pos(model, data)
    data = mjx.fwd_velocity(model, data)
    if model.opt.disableflags & mjx.DisableBit.ACTUATION:  # C then leaves the velocities at zero
        data = with_fields(data, actuator_velocity=jnp.zeros(model.nu, data.qvel.dtype))
    data = mjx.sensor_vel(model, data)
    data = mjx.fwd_actuation(model, data)
    data = inertia.fwd_acceleration(model, data)
    # MJX leaves these sensors out where a model has no constraint rows.
    if jax_fields(data).efc_J.size == 0:
        return sensors.sensor_acc(model, data.replace(qacc=data.qacc_smooth))
    return sensors.sensor_acc(model, solve_constraints(model, data))


def solve_constraints(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Finds the acceleration under constraints, and the constraint forces.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data after ``mjx.fwd_acceleration``, with at least one constraint row.

    Returns:
      The data with ``qacc``, ``qfrc_constraint`` and ``efc_force``.
    """
    impl = jax_fields(data)
    solver = _solve_in_steps
    if limits.supports(model, data) and not early_stop.stops_early(model):
        is_active = limits.past_limit(model, data)
        solver = limits.solve_limits
    elif impl.ne or impl.nf:  # rows that are always active
        is_active = jnp.array(True)
    else:
        is_active = _any_active(data)
    # C has no rows for what is not active, and then copies ``qacc_smooth`` (``mj_fwdConstraint``).
    # MJX has a fixed number of rows, of which those that are not active are zero.
    qacc, qfrc_constraint, efc_force = jax.lax.cond(
        is_active,
        lambda: solver(model, data),
        lambda: (
            data.qacc_smooth,
            jnp.zeros_like(data.qfrc_constraint),
            jnp.zeros_like(impl.efc_force),
        ),
    )
    data = data.replace(qacc=qacc, qfrc_constraint=qfrc_constraint)
    return with_fields(data, efc_force=efc_force)


def _any_active(data: mjx.Data) -> jax.Array:
    """Returns whether any row is active []: a touching contact, or another row that is not zero.

    A NaN counts as active, so that it gets to the acceleration as it does in MJX.
    """
    impl = jax_fields(data)
    num_contact_free = impl.ne + impl.nf + impl.nl
    contact_free = jnp.any(impl.efc_J[:num_contact_free] != 0)
    return contact_free | ~jnp.all(impl.contact.dist - impl.contact.includemargin >= 0)


def _solve_in_steps(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solves by C's search or by Newton's method where they apply, otherwise by MJX's solver.

    Returns:
      The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    if not jax_fields(data).contact.dim.size:  # MJX's solver fails on elliptic cones of none
        model = model.replace(opt=model.opt.replace(cone=mjx.ConeType.PYRAMIDAL))
    if newton.supports(model) and early_stop.stops_early(model):
        # The same search where contacts have no room: another one would stop elsewhere. With all
        # rows it takes long, so that half as much more room is tried before.
        roomier = functools.partial(
            touching.solve_touching, early_stop.solve, early_stop.solve, contacts_per_dof=0.6
        )
        return touching.solve_touching(early_stop.solve, roomier, model, data)
    if newton.supports(model):
        return touching.solve_touching(newton.solve_newton, newton.solve_in_loops, model, data)
    data = mjx.solve(model, data)
    return data.qacc, data.qfrc_constraint, jax_fields(data).efc_force


def runge_kutta_4(
    model: mjx.Model, data: mjx.Data, evaluate: Callable[[mjx.Data], mjx.Data]
) -> mjx.Data:
    """Advances the simulation by one timestep of order 4, as ``mj_RungeKutta`` of C MuJoCo 4.0.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data, with ``ctrl`` set.
      evaluate: the model's forward pass, up to the acceleration.
    """
    start = data
    timestep = model.opt.timestep

    def follow(carry: tuple, row: jax.Array) -> tuple[tuple, sensors.Readings]:
        """Evaluates a stage, adds its weighted rates, and moves from the start to the next."""
        stage, rate, sums = carry
        position, weight, next_position = row
        # The loop's carry keeps its types, which MJX's forward pass does not.
        stage = like(evaluate(stage), stage)
        # The next stage's solver starts at this one's solution. C starts all four where the time
        # step did: the minimum is the same, after more steps (Humanoid, random actions: 1.9, not
        # 1.7). What stops before the minimum has to start there.
        if not early_stop.stops_early(model):
            stage = stage.replace(qacc_warmstart=stage.qacc)
        readings = sensors.readings(model, stage)
        # Rates are averaged where they add up: of one rotation vector since the start of the step,
        # not of velocities in the stages' frames, which MJX averages.
        rate = _displacement_rate(model, stage.qvel, rate, position)
        rates = rate, stage.qacc, stage.act_dot
        sums = tuple(rate_sum + weight * x for rate_sum, x in zip(sums, rates, strict=True))
        # Every stage starts where the step did, and goes on from there at this stage's rates.
        qvel, qacc, act_dot = (next_position * x for x in rates)
        next_data = advance(model, start.replace(qacc=qacc), act_dot, qacc, qvel)
        # Activations go on without their clamp to ``actrange``, which ``advance`` has.
        stage = stage.replace(
            qpos=next_data.qpos,
            qvel=next_data.qvel,
            act=start.act + act_dot * timestep,
            time=start.time + next_position * timestep,
        )
        return (stage, rate, sums), readings

    # A loop, so that XLA compiles one forward pass instead of four.
    zero_sums = jax.tree.map(jnp.zeros_like, (data.qvel, data.qvel, data.act))
    rows = jnp.asarray(_STAGES, data.qpos.dtype)
    (stage, _, sums), readings = jax.lax.scan(follow, (data, data.qvel, zero_sums), rows)
    # In C the sensors show the first stage.
    stage = sensors.with_readings(stage, jax.tree.map(lambda stages: stages[0], readings))
    end = stage.replace(qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time)
    qvel, qacc, act_dot = sums
    # The next step starts its solver at the last stage's acceleration, and shows the mean.
    return advance(model, end, act_dot, qacc, qvel).replace(qacc=qacc)


def like(data: mjx.Data, template: mjx.Data) -> mjx.Data:
    """Returns the new data in the types of the old; MJX makes tendon indices int64 under x64."""
    return jax.tree.map(lambda x, y: x.astype(y.dtype), data, template)


def _displacement_rate(
    model: mjx.Model, qvel: jax.Array, last_rate: jax.Array, position: jax.Array
) -> jax.Array:
    """Returns how fast the displacement since the step's start grows at a stage, [nv].

    Args:
      model: an MJX model; without free and ball joints, the answer is ``qvel``.
      qvel: [nv] the stage's velocity.
      last_rate: [nv] the rate that led to the stage.
      position: [] the stage's place in the timestep, from 0 to 1.
    """
    rate = qvel
    for joint_type, dof in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if joint_type not in (mjx.JointType.FREE, mjx.JointType.BALL):
            continue
        # A free joint has three degrees of freedom of translation before those of rotation.
        start = int(dof) + (3 if joint_type == mjx.JointType.FREE else 0)
        dofs = slice(start, start + 3)
        rotation = position * model.opt.timestep * last_rate[dofs]
        rate = rate.at[dofs].set(_rotation_rate(rotation, qvel[dofs]))
    return rate


def _rotation_rate(rotation: jax.Array, velocity: jax.Array) -> jax.Array:
    r"""Returns the time derivative of a rotation vector r under angular velocity w, [3].

    Bortz (1971), with w in the rotated frame; ``mju_derivExpmap`` of MuJoCo 4.0:

        r' = w + r x w / 2 + c(|r|) r x (r x w),   c(x) = (1 - (x/2) cot(x/2)) / x^2

    c is singular at multiples of 2 pi, so that r is first replaced by the same rotation of an
    angle in (-pi, pi].
    """
    # The angle in (-pi, pi]: small rotations stay as they are, to the last digit.
    square = jnp.sum(rotation**2)
    is_large = square > jnp.pi**2
    angle = jnp.sqrt(jnp.where(is_large, square, 1))
    excess = 2 * jnp.pi * jnp.floor(angle / (2 * jnp.pi) + 0.5)
    rotation = jnp.where(is_large, rotation * (1 - excess / angle), rotation)
    # c is 0/0 at zero: a series there. Both are computed, and neither may be NaN.
    square = jnp.sum(rotation**2)
    is_small = square < _SMALL_SQUARE
    safe_square = jnp.where(is_small, 1, square)
    half_angle = jnp.sqrt(safe_square) / 2
    series = sum(c * square**i for i, c in enumerate(_BORTZ_SERIES))
    closed_form = (1 - half_angle / jnp.tan(half_angle)) / safe_square
    coefficient = jnp.where(is_small, series, closed_form)
    cross_product = jnp.cross(rotation, velocity)
    return velocity + cross_product / 2 + coefficient * jnp.cross(rotation, cross_product)
