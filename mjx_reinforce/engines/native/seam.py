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
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engines.native import gpu_player, handler, ptx
from mjx_reinforce.engines.native.machine import Code

#: LLVM 20, which llvmlite 0.45 has, is the first that reads the IR as it is written here.
_OLDEST = (20,)
#: XLA's name of what launches a kernel that is given as PTX; it is internal to XLA.
_PTX = "__gpu$xla.gpu.ptx"
#: Threads of a block at least, a warp, and blocks on each multiprocessor at most.
_LEAST_THREADS, _MOST_BLOCKS = 32, 16
#: key of the code -> how JAX calls it
_WAYS: dict[str, str] = {}


def unavailable() -> str | None:
    """Returns why JAX cannot run machine code of ours here, None if it can."""
    platform = jax.default_backend()
    if platform not in ("cpu", "gpu", "cuda"):
        return f"it runs on CPUs and NVIDIA GPUs, this is JAX on a {platform}"
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
    if platform != "cpu" and (reason := _unavailable_on_gpu()):
        return reason
    generator = jax.config.values["jax_default_prng_impl"]
    if generator != "threefry2x32":
        return f"it draws noise as threefry2x32 does, not as {generator}"
    if not jax.config.values["jax_threefry_partitionable"]:
        return "it draws noise as JAX does with jax_threefry_partitionable"
    return None


def _unavailable_on_gpu() -> str | None:
    """Returns why kernels of ours cannot run on this GPU, None if they can."""
    import llvmlite.binding as llvm

    capability = compute_capability()
    if capability.partition(".")[0] not in map(str, range(7, 100)):
        return f"it runs on NVIDIA GPUs of compute capability 7.0 or more, this is {capability!r}"
    if jax.config.values["jax_enable_x64"]:
        return "on GPUs it plays in float32 alone, and jax_enable_x64 is set"
    llvm.initialize_all_targets()
    try:
        llvm.Target.from_triple(ptx.TRIPLE)
    except RuntimeError as error:
        return f"this llvmlite has no code for GPUs: {error}"
    return None


def compute_capability() -> str:
    """Returns that of the GPU, such as "9.0"; what other devices say instead; "" if nothing."""
    return str(getattr(jax.devices()[0], "compute_capability", ""))


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


def launch(
    kernel: ptx.Kernel, record: Sequence[jax.ShapeDtypeStruct], horizon: int, *args: Any
) -> Sequence[jax.Array]:
    """Runs a kernel on a GPU; vmapped, it remains one launch.

    Args:
      kernel: of ``gpu_player.kernel_text``.
      record: shape and dtype of the observation, the action and the reward of a step.
      horizon: T, the steps of an episode at most.
      args: active [], deterministic [], keys [N, 2], and the leaves of actor and state [N, ...].

    Returns:
      What the kernel does, without the seeds' axis.
    """

    @jax.custom_batching.custom_vmap
    def play(*args):  # [S, ...]
        return _launch(kernel, record, horizon, *args)

    @play.def_vmap
    def _(size, mapped, *args):
        along = [
            x if is_mapped else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_mapped in zip(args, mapped, strict=True)
        ]
        results = play(*(x.reshape(-1, *x.shape[2:]) for x in along))
        return [x.reshape(size, -1, *x.shape[1:]) for x in results], [True] * len(results)

    return [x[0] for x in play(*(x[None] for x in args))]


def _launch(
    kernel: ptx.Kernel, record: Sequence[jax.ShapeDtypeStruct], horizon: int, *args: Any
) -> Sequence[jax.Array]:
    keys = args[2]
    seeds, episodes = keys.shape[:2]
    shape = jax.ShapeDtypeStruct
    observation, action, reward = (
        shape((seeds, horizon, int(np.prod(x.shape, dtype=int)), episodes), x.dtype) for x in record
    )
    counts = [shape(x, jnp.int32) for x in ((seeds, episodes), (seeds, episodes), (seeds,), (1,))]
    results = [observation, action, reward, *counts]
    given = [jnp.array([seeds, episodes, horizon], jnp.int32), *args]
    zeros = [jnp.zeros(x.shape, x.dtype) for x in results]
    aliases = {len(given) + k: k for k in range(len(results))}
    blocks, threads = _grid(seeds * episodes, kernel.threads)
    call = jax.ffi.ffi_call(_PTX, results, input_output_aliases=aliases)
    return call(
        *given,
        *zeros,
        name=gpu_player.ENTRY,
        kernel_type="ptx",
        kernel_data=kernel.text,
        grid_x=np.int32(blocks),
        grid_y=np.int32(1),
        grid_z=np.int32(1),
        block_x=np.int32(threads),
        block_y=np.int32(1),
        block_z=np.int32(1),
        shared_mem_bytes=np.int32(0),
    )[:-1]


def _grid(items: int, most: int) -> tuple[int, int]:
    """Returns how many blocks of how many threads, at most so many, play so many episodes.

    Few episodes are spread over all multiprocessors. Blocks beyond those that run at once find no
    episode left, and end.
    """
    processors = jax.devices()[0].core_count
    threads = _LEAST_THREADS
    while threads < most and threads * processors < items:
        threads *= 2
    return min(-(-items // threads), _MOST_BLOCKS * processors), threads


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
