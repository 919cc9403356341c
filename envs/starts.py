"""What of a simulation an episode may start with, by mjData's names, and key frames of a model."""

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import MjModel

#: Poses of mocap bodies, which no physics step changes.
MOCAP = ("mocap_pos", "mocap_quat")


def start_shapes(model: MjModel) -> dict[str, tuple[int, ...]]:
    """Returns the shape of each field with which an episode of a model may start."""
    return {
        "qpos": (model.nq,),
        "qvel": (model.nv,),
        "act": (model.na,),
        "ctrl": (model.nu,),
        "mocap_pos": (model.nmocap, 3),
        "mocap_quat": (model.nmocap, 4),
    }


def mocap_poses(fields: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the poses of mocap bodies among fields of a start, or of what is carried."""
    return {name: fields[name] for name in MOCAP if name in fields}


def key_frame(model: MjModel, name: str | int) -> dict[str, jax.Array]:
    """Returns all of a key frame but its time, by mjData's names, see ``start_shapes``.

    Args:
      model: an ``MjModel``.
      name: of the key frame, or its number.

    Raises:
      ValueError: the model has no such key frame.
    """
    names = [model.key(number).name or number for number in range(model.nkey)]
    try:
        key = model.key(name)
    except (KeyError, IndexError) as error:
        choices = ", ".join(map(repr, names)) or "none"
        raise ValueError(f"the model has no key frame {name!r}; it has: {choices}") from error
    values = {
        "qpos": key.qpos,
        "qvel": key.qvel,
        "act": key.act,
        "ctrl": key.ctrl,
        "mocap_pos": key.mpos,
        "mocap_quat": key.mquat,
    }
    dtype = jnp.result_type(float)
    shapes = start_shapes(model)
    return {field: jnp.asarray(x, dtype).reshape(shapes[field]) for field, x in values.items()}


def at_rest(model: MjModel) -> dict[str, jax.Array]:
    """Returns the positions and velocities of a model as it is compiled."""
    dtype = jnp.result_type(float)
    return {"qpos": jnp.asarray(model.qpos0, dtype), "qvel": jnp.zeros(model.nv, dtype)}
