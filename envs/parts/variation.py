"""What differs from robot to robot: fields of the model for ``MujocoEnv.randomize``.

Each returns fields that no other does, so ``friction(...) | masses(...)`` loses none.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import require

#: MuJoCo's mjtGain and mjtBias of motors and servos.
_FIXED_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED)  # pyright: ignore[reportAttributeAccessIssue]
_NO_BIAS = int(mujoco.mjtBias.mjBIAS_NONE)  # pyright: ignore[reportAttributeAccessIssue]
_AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE)  # pyright: ignore[reportAttributeAccessIssue]


def _factors(key: jax.Array, shape: tuple[int, ...], low: float, high: float) -> jax.Array:
    """Returns numbers that are uniform between two; consumes the key."""
    return low + (high - low) * jax.random.uniform(key, shape)


def friction(key: jax.Array, model: MjModel, low: float, high: float) -> dict[str, jax.Array]:
    """Draws one coefficient of sliding friction for all geoms; consumes the key.

    All, since MuJoCo takes the larger one of two geoms: of a floor alone, as in MuJoCo Playground,
    no friction below that of the feet would count. A contact that the model names by a <pair>
    keeps the friction of the pair. Playground draws from 0.4 to 1.0.

    Returns:
      ``geom_friction`` [ngeom, 3].
    """
    coefficients = jnp.asarray(model.geom_friction)
    return {"geom_friction": coefficients.at[:, 0].set(_factors(key, (), low, high))}


def masses(key: jax.Array, model: MjModel, low: float, high: float) -> dict[str, jax.Array]:
    """Multiplies mass and inertia of each body by a factor of its own; consumes the key.

    It is as if the body's density were another. Playground's factors are from 0.9 to 1.1.

    Returns:
      ``body_mass`` [nbody] (kg) and ``body_inertia`` [nbody, 3] (kg m^2).
    """
    factors = _factors(key, (model.nbody,), low, high)
    inertia = factors[:, None] * jnp.asarray(model.body_inertia)
    return {"body_mass": factors * jnp.asarray(model.body_mass), "body_inertia": inertia}


def centers(key: jax.Array, model: MjModel, half_width: ArrayLike) -> dict[str, jax.Array]:
    """Moves the center of mass of the body of the first joint, the root; consumes the key.

    If the body's frame is there, write <body simple="false"> in the model; else
    ``MujocoEnv.randomize`` is refused. Playground moves that of the trunk by up to 0.05 m.

    Args:
      key: of an episode.
      model: the model.
      half_width: [] or [3] the most along each axis of the body's frame (m).

    Returns:
      ``body_ipos`` [nbody, 3] (m).
    """
    shift = half_width * _factors(key, (3,), -1.0, 1.0)
    return {"body_ipos": jnp.asarray(model.body_ipos).at[model.jnt_bodyid[0]].add(shift)}


def armature(key: jax.Array, model: MjModel, low: float, high: float) -> dict[str, jax.Array]:
    """Multiplies the armature of each degree of freedom by a factor; consumes the key.

    Returns:
      ``dof_armature`` [nv] (kg, kg m^2).
    """
    factors = _factors(key, (model.nv,), low, high)
    return {"dof_armature": factors * jnp.asarray(model.dof_armature)}


def damping(key: jax.Array, model: MjModel, low: float, high: float) -> dict[str, jax.Array]:
    """Multiplies the damping of each joint's degrees of freedom by a factor; consumes the key.

    Returns:
      ``dof_damping`` [nv] (N s/m, N m s/rad).
    """
    factors = _factors(key, (model.nv,), low, high)
    return {"dof_damping": factors * jnp.asarray(model.dof_damping)}


def actuators(
    key: jax.Array,
    model: MjModel,
    *,
    stiffness: tuple[float, float] = (1.0, 1.0),
    damping: tuple[float, float] = (1.0, 1.0),
    strength: tuple[float, float] = (1.0, 1.0),
) -> dict[str, jax.Array]:
    """Multiplies what each motor or servo does by factors of its own; consumes the key.

    One function for all three: they change the same fields. The limits of the force stay.

    Args:
      key: of an episode.
      model: the model.
      stiffness: the least and the greatest factor of a position servo's kp, with which both its
        gain and the angle in its bias go.
      damping: those of a servo's kv; that of a velocity servo is its gain, too.
      strength: those of the whole force, also of a motor.

    Returns:
      ``actuator_gainprm`` [nu, 10] and ``actuator_biasprm`` [nu, 10].

    Raises:
      ValueError: an actuator is no motor or servo, such as a muscle.
    """
    biases = np.asarray(model.actuator_biastype)
    is_linear = np.asarray(model.actuator_gaintype) == _FIXED_GAIN
    is_linear &= np.isin(biases, (_NO_BIAS, _AFFINE_BIAS))
    require(
        np.all(is_linear),
        "parts.actuators varies motors and servos, with a fixed gain and no bias or an affine one; "
        "return actuator_gainprm and actuator_biasprm from randomize yourself, since these "
        f"actuators are none: {np.flatnonzero(~is_linear)}",
    )
    gain = jnp.asarray(model.actuator_gainprm)
    bias = jnp.asarray(model.actuator_biasprm)
    ranges = (stiffness, damping, strength)
    kp, kv, force = (
        _factors(part_key, (model.nu,), *limits)
        for part_key, limits in zip(jax.random.split(key, 3), ranges, strict=True)
    )
    # ``mj_fwdActuation``: gain * control + bias0 + bias1 * angle + bias2 * speed. What the control
    # is does not stand in the model, but only a position servo has a bias of the angle.
    is_servo = biases == _AFFINE_BIAS
    holds_angle = is_servo & (model.actuator_biasprm[:, 1] != 0)
    holds_speed = is_servo & ~holds_angle & (model.actuator_biasprm[:, 2] != 0)
    gain_factor = force * jnp.where(holds_angle, kp, jnp.where(holds_speed, kv, 1.0))
    bias_factors = jnp.stack([force, force * kp, force * kv], axis=1)
    return {
        "actuator_gainprm": gain.at[:, 0].set(gain_factor * gain[:, 0]),
        "actuator_biasprm": bias.at[:, :3].set(bias_factors * bias[:, :3]),
    }
