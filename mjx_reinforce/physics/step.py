"""C MuJoCo's step in MJX, with constraint solvers that do less work for the same answer.

The stages are MJX's own, in MJX's order, with seven exceptions:

- ``constraints`` solves for the constraint forces in closed form, or not at all where no constraint
  is active, or with a line search that ends when it is exact.
- ``contacts`` finds the contacts of capsules as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``runge_kutta`` turns free and ball joints as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``inertia.implicitfast`` leaves actuators at a limit out of the derivative by velocity and adds
  the turning of free bodies, as C MuJoCo 4.0 does; MJX 3.17 departs from it.
- ``inertia.tendon_armature`` couples no branches of a tree, as C MuJoCo 4.0 does not.
- ``inertia`` solves from the leaves of the kinematic tree to its root, where it is written out.
- ``forward`` computes the sensors of accelerations without constraints too, where MJX skips them.

Gymnasium runs C MuJoCo, so its answer is the one we want. For a model without such contacts,
joints and ``implicitfast``, such as InvertedPendulum's, a step equals ``mjx.step``.
"""

import functools
from collections.abc import Callable

import jax
from mujoco import mjx

from mjx_reinforce.physics import constraints, contacts, inertia
from mjx_reinforce.physics.mjx_internals import jax_fields
from mjx_reinforce.physics.runge_kutta import like, runge_kutta_4

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
    return mjx.sensor_acc(model, constraints.solve(model, data))
