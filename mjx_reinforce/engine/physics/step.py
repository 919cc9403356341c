"""C MuJoCo's step in MJX, with constraint solvers that do less work for the same answer.

The stages are MJX's own, in MJX's order, with seven exceptions:

- ``solve_constraints`` finds the constraint forces in closed form, or not at all where no
  constraint is active, or with a line search that ends when it is exact.
- ``contacts`` finds the contacts of capsules as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``runge_kutta`` turns free and ball joints as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``inertia.implicitfast`` leaves actuators at a limit out of the derivative by velocity and adds
  the turning of free bodies, as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``inertia.tendon_armature`` couples no branches of a tree, as C MuJoCo 4.0 does not.
- ``inertia`` solves from the leaves of the kinematic tree to its root, where it is written out.
- ``forward`` computes the sensors of accelerations without constraints too, where MJX skips them.

Gymnasium runs C MuJoCo, so its answer is the one we want. For a model without such contacts,
joints and ``implicitfast``, such as InvertedPendulum's, a step equals ``mjx.step``.

MJX's Newton solver is a loop around a line search that is another loop, in every forward pass,
also where no constraint is active. Two cases are cheaper and lead to the same answer:

- Where the only constraint rows are limits of slide and hinge joints, at most two of them to a
  kinematic tree, the optimum has a closed form: ``limits``.
- Otherwise the solver is entered only if some row is active; if none is, the acceleration is the
  unconstrained one. (Under ``jax.vmap`` both branches are computed for every episode.) For all of
  Gymnasium's tasks with contacts the solver is ``newton``, whose line search is exact; MJX's own
  remains for elliptic cones, friction loss and conjugate gradients.

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

from mjx_reinforce.engine.physics import contacts, inertia, limits, newton, touching
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_fields
from mjx_reinforce.engine.physics.runge_kutta import like, runge_kutta_4

__all__ = ["forward", "like", "step"]


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
        return inertia.euler(model, data)
    if integrator == mjx.IntegratorType.IMPLICITFAST:
        return inertia.implicitfast(model, data)
    raise NotImplementedError(f"MJX has no integrator {integrator}")


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes accelerations as ``mjx.forward(model, data)``, except for what this file lists."""
    data = contacts.fwd_position(model, data)
    data = mjx.sensor_pos(model, data)
    data = mjx.fwd_velocity(model, data)
    data = mjx.sensor_vel(model, data)
    data = mjx.fwd_actuation(model, data)
    data = inertia.fwd_acceleration(model, data)
    if jax_fields(data).efc_J.size == 0:
        return mjx.sensor_acc(model, data.replace(qacc=data.qacc_smooth))
    return mjx.sensor_acc(model, solve_constraints(model, data))


def solve_constraints(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Finds the acceleration under constraints, and the constraint forces.

    Args:
      model: an MJX model made with impl='jax'.
      data: its data after ``mjx.fwd_acceleration``, with at least one constraint row.

    Returns:
      The data with ``qacc``, ``qfrc_constraint`` and ``efc_force``.
    """
    fields = jax_fields(data)
    if limits.supports(model, data):
        active, solver = limits.past_limit(model, data), limits.solve_limits
    elif fields.ne or fields.nf:  # rows that are always active
        active, solver = jnp.array(True), _solve_in_steps
    else:
        active, solver = _some_active(data), _solve_in_steps
    qacc, joint_force, force = jax.lax.cond(
        active,
        lambda: solver(model, data),
        lambda: (
            data.qacc_smooth,
            jnp.zeros_like(data.qfrc_constraint),
            jnp.zeros_like(fields.efc_force),
        ),
    )
    return with_fields(data.replace(qacc=qacc, qfrc_constraint=joint_force), efc_force=force)


def _some_active(data: mjx.Data) -> jax.Array:
    """Returns whether some row is active []: a touching contact, or another row that is not zero.

    A NaN counts as active, so that it gets to the acceleration as it does in MJX.
    """
    fields = jax_fields(data)
    others = jnp.any(fields.efc_J[: fields.ne + fields.nf + fields.nl] != 0)
    return others | ~jnp.all(fields.contact.dist - fields.contact.includemargin >= 0)


def _solve_in_steps(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solves by Newton's method where it applies, otherwise by MJX's solver.

    Returns:
      The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    if not jax_fields(data).contact.dim.size:  # MJX's solver fails on elliptic cones of none
        model = model.replace(opt=model.opt.replace(cone=mjx.ConeType.PYRAMIDAL))
    if newton.supports(model, data):
        return touching.solve_touching(newton.solve_newton, model, data)
    data = mjx.solve(model, data)
    return data.qacc, data.qfrc_constraint, jax_fields(data).efc_force
