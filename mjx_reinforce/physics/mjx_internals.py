"""Two changes to how MJX is traced, for XLA's CPU backend; neither changes an answer.

- A body's pose needs every entry of its parent's. XLA fuses the whole chain and then computes the
  parent's entries again for each entry of the child: time grows exponentially with depth. Pusher's
  arm, ten bodies deep, takes a second a state; with a fence between levels, 50 us.
- The contacts of cylinders and ellipsoids are found in ten steps of gradient descent, a loop that
  depends on nothing else in the forward pass. jaxlib 0.10.2 runs such a loop beside other work, and
  for some programs (Pusher, 512 episodes) waits forever for it. Here the steps are written out.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
from mujoco.mjx._src import collision_sdf, scan

_lock = threading.RLock()
_level = scan._nvmap


def fenced(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that traces MJX with both changes."""

    @functools.wraps(fn)
    def traced(*args: Any) -> Any:
        with (
            _lock,
            _swapped(scan, "_nvmap", _fenced_level),
            _swapped(collision_sdf, "_gradient_descent", _descend),
        ):
            return fn(*args)

    return traced


def _fenced_level(*inputs: Any) -> Any:
    """Computes one level of bodies, and lets nothing of it be computed again."""
    return jax.lax.optimization_barrier(_level(*inputs))


def _descend(objective: Callable[..., Any], x: jax.Array, niter: int) -> tuple[Any, jax.Array]:
    """Returns the least distance found [] and where [3], as MJX's `_gradient_descent`."""
    state = collision_sdf.GradientState(dist=1e10, x=x)  # type: ignore
    for _ in range(niter):
        state = collision_sdf._gradient_step(objective, state)
    return state.dist, state.x


@contextlib.contextmanager
def _swapped(module: Any, name: str, value: Any) -> Iterator[None]:
    """Gives a module's name another meaning for a while."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


class Simulation:
    """A read-only view of an ``mjx.Data``: every field of mjData under MuJoCo's own name.

    MJX keeps some fields (``cinert``, ``cfrc_ext``, ``efc_force``, ...) in a part of its own;
    here all stand side by side, as in C.
    """

    def __init__(self, data: Any):
        self._data = data

    def __getattr__(self, name: str) -> Any:
        for part in (self._data, self._data._impl):
            if hasattr(part, name):
                return getattr(part, name)
        raise AttributeError(f"mjx.Data has no field {name!r}; see mjData in MuJoCo's reference")


def num_contacts(data: Any) -> int:
    """Returns the most contacts that a model can have at once, from its ``mjx.Data``."""
    return int(data._impl.ncon)
