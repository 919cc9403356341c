"""Which fields of mjData a task reads, and in which shapes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import DATA_FIELDS

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.cpu.host import Spec
from mjx_reinforce.envs.state import Before, recollect_start, recollect_step
from mjx_reinforce.envs.views import Named

#: Fields that C keeps sparse, where MJX and Gymnasium's documentation have a matrix.
_SPARSE = ("M", "actuator_moment", "flexedge_J", "qLD", "ten_J")


def shape_of(data: Any, name: str) -> tuple[int, ...]:
    """Returns the shape in which a task reads a field of mjData: rotations are [n, 3, 3].

    Args:
      data: an ``MjData``.
      name: of the field.

    Raises:
      ValueError: C MuJoCo has no such field of a fixed size.
    """
    if name in _SPARSE:
        raise ValueError(f"the task reads {name}, which C MuJoCo keeps as a sparse matrix")
    if name not in DATA_FIELDS:
        raise ValueError(f"the task reads {name}, which is not an array of mjData of a fixed size")
    shape = np.shape(getattr(data, name))
    return (shape[0], 3, 3) if name.endswith("mat") and shape[1:] == (9,) else shape


class FieldRecorder(Named):
    """An mjData of zeros that remembers which of its fields were read."""

    def __init__(self, data: Any, mj_model: MjModel):
        self.mj_model = mj_model
        self.episode = {}
        self.memory = {}
        self.data = data
        self.names: set[str] = set()

    def __getattr__(self, name: str) -> jax.Array:
        if name.startswith("__"):
            raise AttributeError(name)
        spec = spec_of(self.data, name)
        self.names.add(name)
        return jnp.zeros(spec.shape, spec.dtype)


def fields_read(
    env: Any, data: Any, start_fields: dict[str, Any], episode: dict[str, Any]
) -> set[str]:
    """Returns which fields of mjData the methods of a task read of a simulation.

    That does not depend on their numbers: the methods are traced, as under jit.

    Args:
      env: the ``MujocoEnv``.
      data: an ``MjData`` of its model, which stays as it is.
      start_fields: what the task knows of the start of an env step, by mjData's names.
      episode: what ``randomize`` returned, or what has its shapes.

    Raises:
      ValueError: the task reads what C MuJoCo has in no array of a fixed size.
    """
    recorder: Any = FieldRecorder(data, env.mj_model)

    def read(start_fields: dict[str, Any], episode: dict[str, Any], action: jax.Array) -> None:
        """Calls the methods, of the start of an episode and of an env step."""
        recorder.episode = episode
        recollection = recollect_start(env, jax.random.key(0), recorder)
        before = Before(start_fields, env.mj_model, episode, recollection.memory)
        env.actuate(before, action)
        if env.has_pushes:
            env.push(before)
        recollect_step(env, recollection, recorder, action)
        env.outcome(before, recorder, action)
        env.observe(recorder)

    jax.eval_shape(read, start_fields, episode, jnp.zeros(env.action_size))
    return recorder.names


def spec_of(data: Any, name: str) -> Spec:
    """Returns the shape and dtype in which a task reads a field of mjData: JAX's own of its kind.

    Raises:
      ValueError: C MuJoCo has no such field of a fixed size.
    """
    shape = shape_of(data, name)
    integers = np.issubdtype(np.asarray(getattr(data, name)).dtype, np.integer)
    return Spec(shape, jnp.result_type(int if integers else float))
