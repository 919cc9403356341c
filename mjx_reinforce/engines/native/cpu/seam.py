"""How JAX calls machine code on a CPU; here and in the GPU's ``seam`` alone stands ``jax.ffi``.

XLA's CPU runtime calls the handler itself, within compiled programs and loops, without Python.
Where it does not take the handler, ``jax.pure_callback`` runs the same code: about 1 ms a call
instead of 0.4 µs, and XLA's programs are not cached then.
"""

import atexit
import ctypes
import functools
import os
import re
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_reinforce.engines.native import objects
from mjx_reinforce.engines.native.cpu import emit, handler, machine
from mjx_reinforce.engines.native.cpu.machine import Code

_WAITING = Path(__file__).with_name("waiting.ll")
#: key of the code -> how JAX calls it
_WAYS: dict[str, str] = {}


def call(
    code: Code,
    results: Sequence[jax.ShapeDtypeStruct],
    *args: jax.Array,
    positions: handler.Positions = handler.EPISODES,
) -> Sequence[jax.Array]:
    """Calls machine code under any transformation but differentiation.

    Args:
      code: functions of ``handler.NAMES``.
      results: shapes and dtypes of what it returns, as ``handler.handler_text`` says.
      args: arrays, as ``handler.handler_text`` says; vmapped, all get the new axis in front.
      positions: as for ``handler.handler_text``.
    """
    if way(code) == "callback":
        play = functools.partial(_play, code, results, positions)
        return jax.pure_callback(play, results, *args, vmap_method="broadcast_all")
    return jax.ffi.ffi_call(_target(code.key), results, vmap_method="broadcast_all")(*args)


def way(code: Code) -> str:
    """Returns how JAX calls the code: "ffi", or "callback" where XLA does not take its handler."""
    if code.key not in _WAYS:
        _WAYS[code.key] = "ffi" if _register(code) else "callback"
    return _WAYS[code.key]


def targets() -> list[str]:
    """Returns XLA's names of all handlers that there are in memory."""
    return [_target(key) for key in machine.in_memory()]


def restore(program: bytes) -> bool:
    """Makes ready the machine code that a program calls, from disk; returns whether all is there.

    Args:
      program: as JAX exports it, or anything else that has the names of handlers in it.
    """
    folder = objects.folder()
    for name in set(re.findall(rb"mjx_reinforce_([0-9a-f]{64})", program)):
        code = machine.loaded(name.decode(), handler.NAMES, folder) if folder else None
        if code is None or way(code) != "ffi":
            return False
    return True


def _target(key: str) -> str:
    """Returns XLA's name of the handler; programs in JAX's cache find it again by it."""
    return f"mjx_reinforce_{key}"


def _register(code: Code) -> bool:
    """Tells XLA where the handler is; returns whether it took it."""
    jax.devices()  # a handler refused before XLA has started would keep it from starting
    address = ctypes.c_void_p(code.addresses["handler"] if code.made.done() else _waiting(code))
    try:
        jax.ffi.register_ffi_target(_target(code.key), jax.ffi.pycapsule(address), platform="cpu")
    except (AttributeError, RuntimeError):  # jax.ffi has changed; XLA speaks another version
        return False
    return True


def _waiting(code: Code) -> int:
    """Returns a handler that waits for that of code which is still compiled, and calls it.

    XLA compiles the program around it meanwhile.
    """
    text = f"; waits for {code.key}\n{handler.with_entry(_WAITING, {})}"
    names, target = ("handler", "slot", "failed"), machine.this_machine()
    found = machine.load_module(text, lambda: text, names, target, None).addresses

    def fill(made: Future[dict[str, int]]) -> None:
        ready = found["failed"] if made.exception() else made.result()["handler"]
        ctypes.c_void_p.from_address(found["slot"]).value = ready

    code.made.add_done_callback(fill)
    atexit.register(emit.end_processes)  # before JAX ends, which waits for running programs
    return found["handler"]


def _play(
    code: Code,
    results: Sequence[jax.ShapeDtypeStruct],
    positions: handler.Positions,
    *args: jax.Array,
) -> list[np.ndarray]:
    """Plays without XLA: on threads of its own, from NumPy arrays."""
    given = [np.asarray(x, order="C") for x in args]
    threads, items = given[positions.threads], given[positions.items]
    mapped = threads.shape[: threads.ndim + 2 - len(results[positions.steps].shape)]
    made: list[Any] = [np.empty(mapped + x.shape, x.dtype) for x in results]
    data = (ctypes.c_void_p * (len(given) + len(made)))(*(x.ctypes.data for x in [*given, *made]))
    sizes = (ctypes.c_int64 * len(made))(*(x.nbytes for x in made))
    episodes, horizon = items.shape[-2], made[positions.steps].shape[-2]
    job = _function(code, "open", 2, 3)(data, sizes, threads.size, episodes, horizon)
    most = os.cpu_count() or 1
    count = min(int(threads.flat[0]) or most, most)
    with ThreadPoolExecutor(count) as pool:
        for _ in range(count):
            pool.submit(_function(code, "share", 1, 0), job)
    _function(code, "close", 1, 0)(job)
    return made


def _function(code: Code, name: str, num_pointers: int, num_integers: int) -> Any:
    """Returns a function for Python to call; it returns a pointer."""
    kinds = [ctypes.c_void_p] * num_pointers + [ctypes.c_int64] * num_integers
    return ctypes.CFUNCTYPE(ctypes.c_void_p, *kinds)(code.addresses[name])
