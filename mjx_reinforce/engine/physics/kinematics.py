"""Where everything is, with bodies that go with the mocap body that carries them."""

import jax.numpy as jnp
from mujoco import mjx


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes poses as ``mjx.kinematics(model, data)``, and children of mocap bodies as C.

    MJX moves mocap bodies last, and leaves what they carry where the model has it.
    """
    if not model.nmocap:
        return mjx.kinematics(model, data)
    is_mocap = model.body_mocapid >= 0
    quat = data.mocap_quat / jnp.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
    poses = {
        "body_pos": jnp.asarray(model.body_pos).at[is_mocap].set(data.mocap_pos),
        "body_quat": jnp.asarray(model.body_quat).at[is_mocap].set(quat),
    }
    return mjx.kinematics(model.replace(**poses), data)
