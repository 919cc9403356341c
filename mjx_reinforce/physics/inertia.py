"""Solves with the inertia matrix, from the leaves of the kinematic tree to its root.

The matrix has zeros where no path from the root holds both degrees of freedom. MJX eliminates the
root's degrees of freedom first, which fills these zeros. From the leaves on they stay zeros
(Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.5; ``mj_factorI`` of C MuJoCo), and
``fused`` writes nothing for them: of the 4,190 operations of Humanoid's factor 1,763 are left.
"""

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.fused import by_engine
from mjx_reinforce.physics.mjx_internals import advance, solve_m


def inverse_times(model: mjx.Model, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Returns inv(M) force, [nv].

    Args:
      model: an MJX model made with impl='jax'.
      data: its data after ``mjx.factor_m``.
      force: [nv]
    """
    return by_engine(
        lambda: _from_leaves(mjx.full_m(model, data), force), lambda: solve_m(model, data, force)
    )


def fwd_acceleration(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes the acceleration without constraints, as ``mjx.fwd_acceleration``."""
    data = mjx.fwd_acceleration(model, data)
    return data.replace(
        qacc_smooth=by_engine(
            lambda: _from_leaves(mjx.full_m(model, data), data.qfrc_smooth),
            lambda: data.qacc_smooth,
        )
    )


def euler(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advances by one timestep with damping at the step's end, as ``mjx.euler``."""
    if model.opt.disableflags & mjx.DisableBit.EULERDAMP:
        return mjx.euler(model, data)

    damped = mjx.full_m(model, data) + jnp.diag(model.opt.timestep * model.dof_damping)
    force = data.qfrc_smooth + data.qfrc_constraint

    return advance(model, data, data.act_dot, solve(damped, force))


def solve(matrix: jax.Array, force: jax.Array) -> jax.Array:
    """Returns inv(matrix) force, [nv], for an inertia matrix to which a positive one was added."""

    def whole() -> jax.Array:  # as MJX, where its matrices are dense
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), force)

    return by_engine(lambda: _from_leaves(matrix, force), whole)


def _from_leaves(inertia: jax.Array, force: jax.Array) -> jax.Array:
    """Solves; the degrees of freedom [nv] of a body come after those of its parent."""
    factor = jax.scipy.linalg.cho_factor(inertia[::-1, ::-1], lower=True)
    return jax.scipy.linalg.cho_solve(factor, force[::-1])[::-1]
