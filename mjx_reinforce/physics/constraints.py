"""Which solver finds the constraint forces, and whether one is needed at all.

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
or a
small improvement, ``newton`` only at the optimum or at a step too small to count: now and then it
makes one iteration more than C, and ends nearer to the optimum.
"""

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.physics import limits, newton, touching
from mjx_reinforce.physics.mjx_internals import jax_fields, with_solution


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
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
        active, solver = jnp.array(True), _iterate
    else:
        active, solver = _some_active(data), _iterate
    solution = jax.lax.cond(
        active,
        lambda: solver(model, data),
        lambda: (
            data.qacc_smooth,
            jnp.zeros_like(data.qfrc_constraint),
            jnp.zeros_like(fields.efc_force),
        ),
    )
    return with_solution(data, *solution)


def _some_active(data: mjx.Data) -> jax.Array:
    """Returns whether some row is active []: a touching contact, or another row that is not zero.

    A NaN counts as active, so that it gets to the acceleration as it does in MJX.
    """
    fields = jax_fields(data)
    others = jnp.any(fields.efc_J[: fields.ne + fields.nf + fields.nl] != 0)
    return others | ~jnp.all(fields.contact.dist - fields.contact.includemargin >= 0)


def _iterate(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
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
