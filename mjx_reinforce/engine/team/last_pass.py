"""Fields that follow from the last forward pass of a simulation that others have computed.

A kernel whose lanes play an episode together shows few fields of mjData. From the positions,
velocities and accelerations of its last forward pass the program of the task computes the others
that it reads, and the sensors.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics import mjx_internals, sensors
from mjx_reinforce.engine.physics.mjx_internals import Simulation, jax_fields, with_fields
from mjx_reinforce.engine.team import flags

_C: Any = mujoco  # a C extension without stubs
_FIELDS = frozenset(
    (
        *("xquat", "xmat", "ximat", "xanchor", "xaxis", "subtree_com"),
        *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat"),
        *("ten_length", "ten_velocity"),
        *("actuator_length", "actuator_velocity", "actuator_force"),
    )
)
#: How many axes of a sensor's zone are round; of a capsule they are not the first.
ROUND_AXES = {
    int(_C.mjtGeom.mjGEOM_SPHERE): 3,
    int(_C.mjtGeom.mjGEOM_ELLIPSOID): 3,
    int(_C.mjtGeom.mjGEOM_CYLINDER): 2,
    int(_C.mjtGeom.mjGEOM_BOX): 0,
}


def touch_sensors(mj_model: MjModel) -> np.ndarray:
    """Returns the numbers of the sensors of touch that the kernel has."""
    model: Any = mj_model
    is_touch = model.sensor_type == _C.mjtSensor.mjSENS_TOUCH
    sites = np.where(is_touch, model.sensor_objid, 0)
    kinds = model.site_type[sites] if model.nsite else sites
    return np.flatnonzero(is_touch & np.isin(kinds, list(ROUND_AXES)))


def _shows_sensors(mj_model: MjModel) -> bool:
    """Returns whether all sensors follow from a pass, and from what ``touch_sensors`` show."""
    model: Any = mj_model
    types = _C.mjtSensor
    num_touches = np.sum(model.sensor_type == types.mjSENS_TOUCH)
    # In C the sensors of a Runge-Kutta step show its first stage, which is not its last pass.
    is_rk4 = model.opt.integrator == _C.mjtIntegrator.mjINT_RK4
    is_unknown = np.isin(model.sensor_type, (types.mjSENS_CONTACT, types.mjSENS_CLOCK))
    if flags.is_off(model, "sensor"):
        return False
    return not (is_rk4 or is_unknown.any()) and len(touch_sensors(model)) == num_touches


def completed_data(
    mj_model: MjModel, model: mjx.Model, data: mjx.Data, touch: jax.Array
) -> mjx.Data:
    """Returns the data with all fields of ``Completed``.

    Args:
      mj_model: the model.
      model: MJX's version of it.
      data: ``qpos``, ``qvel``, ``qacc``, ``ctrl``, ``time`` and ``cfrc_ext`` of a forward pass.
      touch: what ``touch_sensors`` show [n] (N).
    """
    data = mjx_internals.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.camlight(model, data)
    data = mjx.tendon(model, data)
    data = mjx.transmission(model, data)
    data = mjx.sensor_pos(model, data)
    impl = jax_fields(data)
    data = with_fields(
        data,
        actuator_velocity=impl.actuator_moment @ data.qvel,
        ten_velocity=impl.ten_J @ data.qvel,
    )
    data = mjx.com_vel(model, data)
    data = mjx.sensor_vel(model, data)
    data = mjx.fwd_actuation(model, data)
    # The contacts are not known, but what all forces on a body add up to.
    torque, force = jnp.split(impl.cfrc_ext, 2, axis=1)
    arm = data.subtree_com[model.body_rootid] - data.xipos
    wrench = jnp.concatenate([force, torque + jnp.cross(arm, force)], axis=1)
    # Spatial tendons are among these already, and ``sensor_acc`` adds them.
    wrench -= sensors.with_tendons(model, data.replace(xfrc_applied=0 * wrench)).xfrc_applied
    empty = jax.tree.map(lambda x: x[:0], impl.contact)
    data = with_fields(data, contact=empty.replace(dim=impl.contact.dim[:0]))
    data = sensors.sensor_acc(
        model.replace(eq_type=np.full_like(model.eq_type, -1)), data.replace(xfrc_applied=wrench)
    )
    ids = touch_sensors(mj_model)
    cutoff = np.where(model.sensor_cutoff[ids] > 0, model.sensor_cutoff[ids], np.inf)
    rows = model.sensor_adr[ids]
    return data.replace(sensordata=data.sensordata.at[rows].set(jnp.minimum(touch, cutoff)))


class Completed(Simulation):
    """A simulation of which some fields are computed where they are read."""

    def __init__(self, mj_model: MjModel, data: Any, complete: Callable[[], mjx.Data]):
        """Computes nothing yet.

        Args:
          mj_model: the model.
          data: what is known.
          complete: returns ``completed_data`` of its last forward pass.
        """
        super().__init__(data)
        self._names = _FIELDS | {"sensordata"} if _shows_sensors(mj_model) else _FIELDS
        self._complete = complete

    def __getattr__(self, name: str) -> Any:
        if name in self._names:
            return getattr(Simulation(self._complete()), name)
        return super().__getattr__(name)
