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


def read_all(env: Any, before: Before, recorder: Any, action: jax.Array) -> None:
    """Calls the methods of a task that read a simulation; which fields these are is recorded.

    Args:
      env: the ``MujocoEnv``.
      before: the start of an env step.
      recorder: a ``FieldRecorder`` in place of the simulation after it.
      action: [A] of any numbers.
    """
    recollection = recollect_start(env, jax.random.key(0), recorder)
    before.memory = dict(recollection.memory)
    env.actuate(before, action)
    if env.has_pushes:
        env.push(before)
    recollect_step(env, recollection, recorder, action)
    env.outcome(before, recorder, action)
    env.observe(recorder)


def spec_of(data: Any, name: str) -> Spec:
    """Returns the shape and dtype in which a task reads a field of mjData: JAX's own of its kind.

    Raises:
      ValueError: C MuJoCo has no such field of a fixed size.
    """
    shape = shape_of(data, name)
    integers = np.issubdtype(np.asarray(getattr(data, name)).dtype, np.integer)
    return Spec(shape, jnp.result_type(int if integers else float))
