"""How JAX calls machine code: the one file that knows ``jax.ffi``.

XLA's CPU runtime calls the handler itself, within compiled programs and loops, without Python.
Where it does not take the handler, ``jax.pure_callback`` runs the same code: about 1 ms a call
instead of 1 µs, and XLA's programs are not cached then.
"""

import ctypes
import functools
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_reinforce.engines.native import handler
from mjx_reinforce.engines.native.machine import Code

#: LLVM 20, which llvmlite 0.45 has, is the first that reads the IR as it is written here.
_OLDEST = (20,)
#: key of the code -> how JAX calls it
_WAYS: dict[str, str] = {}


def unavailable() -> str | None:
    """Returns why JAX cannot run machine code of ours here, None if it can."""
    platform = jax.default_backend()
    if platform != "cpu":
        return f"it runs on CPUs, this is JAX on a {platform}"
    if sys.platform == "win32":
        return "it was never tried on Windows"
    if sys.maxsize < 2**32 or sys.byteorder != "little":
        return "it needs a little-endian machine of 64 bits"
    try:
        import llvmlite.binding
    except (ImportError, OSError) as error:
        return f"llvmlite cannot be loaded: {error}; pip install 'llvmlite>=0.45'"
    if llvmlite.binding.llvm_version_info < _OLDEST:
        return f"llvmlite {llvmlite.__version__} is too old; pip install 'llvmlite>=0.45'"
    generator = jax.config.values["jax_default_prng_impl"]
    if generator != "threefry2x32":
        return f"it draws noise as threefry2x32 does, not as {generator}"
    if not jax.config.values["jax_threefry_partitionable"]:
        return "it draws noise as JAX does with jax_threefry_partitionable"
    return None


def cache_folder() -> Path | None:
    """Returns where compiled objects are kept: beside JAX's programs; None if JAX keeps none."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder or "://" in folder or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    return Path(folder) / "native"


def call(code: Code, results: Sequence[jax.ShapeDtypeStruct], *args: Any) -> Sequence[jax.Array]:
    """Calls machine code under any transformation but differentiation.

    Args:
      code: functions of ``handler.NAMES``.
      results: shapes and dtypes of what it returns, as ``handler.handler_text`` says.
      args: arrays, likewise; vmapped, all get the new axis in front.
    """
    if way(code) == "callback":
        play = functools.partial(_play, code, results)
        return jax.pure_callback(play, results, *args, vmap_method="broadcast_all")
    return jax.ffi.ffi_call(_target(code), results, vmap_method="broadcast_all")(*args)


def way(code: Code) -> str:
    """Returns how JAX calls the code: "ffi", or "callback" where XLA does not take its handler."""
    if code.key not in _WAYS:
        _WAYS[code.key] = "ffi" if _register(code) else "callback"
    return _WAYS[code.key]


def _target(code: Code) -> str:
    """Returns XLA's name of the handler; programs in JAX's cache find it again by it."""
    return f"mjx_reinforce_{code.key}"


def _register(code: Code) -> bool:
    """Tells XLA where the handler is; returns whether it took it."""
    jax.devices()  # a handler refused before XLA has started would keep it from starting
    address = ctypes.c_void_p(code.addresses["handler"])
    try:
        jax.ffi.register_ffi_target(_target(code), jax.ffi.pycapsule(address), platform="cpu")
    except (AttributeError, RuntimeError):  # jax.ffi has changed; XLA speaks another version
        return False
    return True


def _play(code: Code, results: Sequence[jax.ShapeDtypeStruct], *args: Any) -> list[np.ndarray]:
    """Plays without XLA: on threads of its own, from NumPy arrays."""
    given = [np.asarray(x, order="C") for x in args]
    active, threads, keys = (given[i] for i in (handler.ACTIVE, handler.THREADS, handler.KEYS))
    mapped = active.shape[: active.ndim - len(results[handler.SIMULATED].shape)]
    made: list[Any] = [np.empty(mapped + x.shape, x.dtype) for x in results]
    data = (ctypes.c_void_p * (len(given) + len(made)))(*(x.ctypes.data for x in [*given, *made]))
    sizes = (ctypes.c_int64 * len(made))(*(x.nbytes for x in made))
    episodes, horizon = keys.shape[-2], made[handler.REWARD].shape[-2]
    job = _function(code, "open", 2, 3)(data, sizes, active.size, episodes, horizon)
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
