"""What stands in the place of Playground's physics while a task of Playground is traced.

A task calls three functions for its physics: ``mjx_env.make_data`` and ``mjx.forward`` where an
episode begins, and ``mjx_env.step`` once an env step.
"""

import contextlib
import functools
import importlib
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics import mjx_internals
from mjx_reinforce.envs.c_mujoco.fields import spec_of
from mjx_reinforce.envs.starts import at_rest, start_shapes

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: The functions of modules are those of the process: one thread exchanges them at a time.
_LOCK = threading.RLock()


class PhysicsReached(Exception):  # noqa: N818 (no error: it ends a trace)
    """A task's ``step`` has come to its physics."""


@jax.tree_util.register_pytree_node_class
class TaskData:
    """A simulation as Playground's tasks read and replace it, in place of an ``mjx.Data``."""

    def __init__(self, fields: Mapping[str, Any], source: Any = None):
        """Shows fields of mjData by their names.

        Args:
          fields: what is known, or has been replaced.
          source: what has the other fields.
        """
        self.fields = dict(fields)
        self.source = source

    def __getattr__(self, name: str) -> Any:
        """Returns a field of mjData."""
        if name.startswith("__"):
            raise AttributeError(name)
        if name == mjx_internals.OWN_FIELDS:  # they have no place of their own here
            return self
        if name in self.fields:
            return self.fields[name]
        return getattr(self.source, name)

    def replace(self, **fields: Any) -> "TaskData":
        """Returns the simulation with other numbers in some fields."""
        return TaskData(self.fields | fields, self.source)

    def tree_replace(self, fields: Mapping[str, Any]) -> "TaskData":
        """Returns the simulation with other numbers in some fields."""
        return self.replace(**fields)

    def tree_flatten(self) -> tuple[tuple[dict[str, Any]], Any]:
        """Returns the fields that are known; the source stays what it is."""
        return (self.fields,), self.source

    @classmethod
    def tree_unflatten(cls, source: Any, children: tuple[dict[str, Any]]) -> "TaskData":
        """Returns the simulation of ``tree_flatten``."""
        return cls(children[0], source)


class _Constant:
    """A simulation of which every number is the same."""

    def __init__(self, model: MjModel, number: float):
        self._data = _C.MjData(model)
        self._number = number

    def __getattr__(self, name: str) -> jax.Array:
        spec = spec_of(self._data, name)
        return jnp.full(spec.shape, self._number if np.issubdtype(spec.dtype, np.floating) else 0)


class _Forwarded:
    """What follows from the fields of a start, computed where it is read."""

    def __init__(self, compute: Callable[[], Any]):
        self._compute = functools.cache(compute)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._compute(), name)


class Start:
    """What stands in the place of a task's physics where an episode begins.

    fields: those of the start, by mjData's names, as the last call of the physics got them.
    calls: how often the physics was called.
    settle_steps: physics steps before the episode begins, after all else.
    """

    def __init__(
        self, model: MjModel, forward: Callable[..., Any], data: Any = None, last_call: int = 0
    ):
        """Shows what an engine has computed, or what it will start from.

        Args:
          model: the task's.
          forward: (fields of mjData) -> simulation, a forward pass.
          data: the simulation at the start of the episode, if it is known.
          last_call: the number of the call of the physics that returns ``data``.
        """
        self._model = model
        self._forward = forward
        self._data = data
        self._last_call = last_call
        self.fields: dict[str, Any] = {}
        self.calls = 0
        self.settle_steps = 0

    def make_data(self, model: Any, **fields: Any) -> TaskData:
        """Stands for ``mjx_env.make_data``."""
        shapes = start_shapes(self._model)
        dtype = jnp.result_type(float)
        arrays = {
            name: jnp.asarray(x, dtype).reshape(shapes[name])
            for name, x in fields.items()
            if name in shapes and x is not None
        }
        # Without a forward pass, MJX's simulation has zeros.
        return TaskData(_at_start(self._model) | arrays, _Constant(self._model, 0.0))

    def forward(self, model: Any, data: TaskData) -> TaskData:
        """Stands for ``mjx.forward``."""
        if self.settle_steps:
            raise NotImplementedError("its reset calls mjx.forward after physics steps")
        return self._simulated(data)

    def step(self, model: Any, data: TaskData, action: Any, n_substeps: int = 1) -> TaskData:
        """Stands for ``mjx_env.step``: the start settles under controls that hold."""
        if self.settle_steps:
            raise NotImplementedError("its reset calls mjx_env.step more than once")
        self.settle_steps = int(n_substeps)
        return self._simulated(data.replace(ctrl=action))

    def _simulated(self, data: TaskData) -> TaskData:
        """Returns what a call of the physics makes of a simulation."""
        self.calls += 1
        self.fields = dict(data.fields)
        if self._data is not None and self.calls >= self._last_call:
            return TaskData({}, self._data)
        if self.settle_steps:
            # The engine will compute it: a start that depended on it would be NaN.
            return TaskData({}, _Constant(self._model, jnp.nan))
        return TaskData(self.fields, _Forwarded(functools.partial(self._forward, self.fields)))


def _at_start(model: MjModel) -> dict[str, jax.Array]:
    """Returns the fields with which an episode may start, as the model has them."""
    data = _C.MjData(model)
    dtype = jnp.result_type(float)
    fields = {name: jnp.asarray(getattr(data, name), dtype) for name in start_shapes(model)}
    return fields | at_rest(model)


class Step:
    """What stands in the place of a task's physics in an env step.

    control: [nu] what the task applies.
    data: the simulation that it applies it to.
    calls: how often the physics was called.
    """

    def __init__(self, frame_skip: int, data: Any = None):
        """Shows ``data`` as what the physics returns; by default the trace ends there."""
        self._frame_skip = frame_skip
        self._data = data
        self.control: Any = None
        self.data: Any = None
        self.calls = 0

    def make_data(self, *_: Any, **__: Any) -> TaskData:
        """Stands for ``mjx_env.make_data``."""
        raise NotImplementedError("its step makes a simulation of its own")

    def forward(self, model: Any, data: Any) -> TaskData:
        """Stands for ``mjx.forward``."""
        raise NotImplementedError("its step calls mjx.forward")

    def step(self, model: Any, data: TaskData, action: Any, n_substeps: int = 1) -> TaskData:
        """Stands for ``mjx_env.step``."""
        if n_substeps != self._frame_skip:
            raise NotImplementedError(
                f"an env step of it has {n_substeps} physics steps, and its n_substeps is "
                f"{self._frame_skip}"
            )
        self.calls += 1
        self.control = action
        self.data = data
        if self._data is None:
            raise PhysicsReached
        return TaskData({}, self._data)


@contextlib.contextmanager
def exchanged(physics: Any) -> Iterator[None]:
    """Has tasks of Playground call other functions for their physics; undone on leaving.

    Args:
      physics: it has ``make_data``, ``forward`` and ``step``.
    """
    package = importlib.import_module("mujoco_playground")
    module = importlib.import_module("mujoco_playground._src.mjx_env")
    places = (
        (module, "make_data", physics.make_data),
        (module, "step", physics.step),
        (package, "step", physics.step),
        (mjx, "forward", physics.forward),
    )
    with _LOCK, contextlib.ExitStack() as stack:
        for place, name, function in places:
            stack.callback(setattr, place, name, getattr(place, name))
            setattr(place, name, function)
        yield
