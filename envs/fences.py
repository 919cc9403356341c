"""Fences in MJX's scans over bodies, for deep kinematic trees on a CPU.

A body's pose needs every entry of its parent's. XLA's CPU backend fuses the whole chain and then
computes the parent's entries again for each entry of the child: time grows exponentially with
depth. Pusher's arm, ten bodies deep, takes a second a state; with a fence between levels, 50 us.
"""

import functools
import threading
from collections.abc import Callable
from typing import Any

import jax
from mujoco.mjx._src import scan

_lock = threading.RLock()


def fenced(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that traces with an optimisation barrier after each level of bodies."""

    @functools.wraps(fn)
    def traced(*args: Any) -> Any:
        with _lock:
            level = scan._nvmap
            scan._nvmap = lambda *inputs: jax.lax.optimization_barrier(level(*inputs))
            try:
                return fn(*args)
            finally:
                scan._nvmap = level

    return traced
