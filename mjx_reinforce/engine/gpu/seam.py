"""How JAX launches kernels on an NVIDIA GPU.

A kernel is launched within compiled programs and loops without Python: a handler of JAX's foreign
function interface launches machine code, which NVRTC makes while XLA compiles.
"""

import ctypes
import functools
import math
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import mlir

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import cubin, loops, nvrtc
from mjx_reinforce.engine.gpu import team_kernel as team
from mjx_reinforce.engine.gpu.source import WARP

#: XLA's names of the handlers that it knows, and what compiles the kernel of each.
_HANDLERS: dict[str, threading.Thread] = {}
_LOCK = threading.Lock()


def kernels_unavailable() -> str | None:
    """Returns why kernels of ours cannot run on this GPU, None if they can."""
    capability = compute_capability()
    if capability.partition(".")[0] not in map(str, range(7, 100)):
        return f"it runs on NVIDIA GPUs of compute capability 7.0 or more, this is {capability!r}"
    if jax.config.values["jax_enable_x64"]:
        return "on GPUs it plays in float32 alone, and jax_enable_x64 is set"
    return _why_not_compiled()


@functools.cache
def _why_not_compiled() -> str | None:
    """Returns why nothing compiles kernels for these GPUs and loads them, or None."""
    capabilities = {getattr(x, "compute_capability", "") for x in jax.local_devices()}
    if len(capabilities) > 1:
        return f"its kernels are for GPUs of one kind, not {' and '.join(sorted(capabilities))}"
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "NVIDIA's driver, libcuda.so.1, is not found"
    return nvrtc.why_not(compute_capability())


def targets() -> list[str]:
    """Returns XLA's names of the handlers of all kernels in memory."""
    return [_target(key) for key in cubin.in_memory()]


def restore(program: bytes) -> bool:
    """Makes ready the kernels that a program launches, from disk; returns whether all are there.

    Args:
      program: as JAX exports it, or anything else that has the names of handlers in it.
    """
    folder = objects.folder()
    # XLA writes the names of handlers into its programs as they are: no need to parse one.
    keys = set(re.findall(rb"mjx_reinforce_gpu_([0-9a-f]{64})", program))
    for key in keys:
        kernel = cubin.kept(key.decode(), folder) if folder else None
        if kernel is None or _why_not_compiled():
            return False
        _handler(kernel)
    return True


def _target(key: str) -> str:
    """Returns XLA's name of the handler of a kernel; kept programs find it again by it."""
    return f"mjx_reinforce_gpu_{key}"


def _handler(kernel: cubin.Kernel) -> str:
    """Returns XLA's name of the handler that launches a kernel, which is compiled meanwhile."""
    name = _target(kernel.key)
    with _LOCK:
        if name not in _HANDLERS:
            handler, slot = cubin.launcher(kernel.key)
            address = jax.ffi.pycapsule(ctypes.c_void_p(handler))
            jax.ffi.register_ffi_target(name, address, platform="CUDA")
            # A daemon, so that a program that ends early need not wait for NVIDIA's compiler.
            arguments = (slot, kernel, compute_capability(), objects.folder())
            _HANDLERS[name] = threading.Thread(target=cubin.fill, args=arguments, daemon=True)
            _HANDLERS[name].start()
    return name


def wait_for_kernels() -> None:
    """Waits until all kernels are compiled, so that no launch waits while its time is taken."""
    with _LOCK:
        compilers = list(_HANDLERS.values())
    for compiler in compilers:
        compiler.join()


def compute_capability() -> str:
    """Returns that of the GPU, such as "9.0"; what other devices say instead; "" if nothing."""
    return str(getattr(jax.devices()[0], "compute_capability", ""))


def _num_processors() -> int:
    """Returns how many multiprocessors the GPU has."""
    return jax.devices()[0].core_count


def kernel_dependencies() -> str:
    """Returns what a program with kernels depends on."""
    processors = f"{_num_processors()} multiprocessors"
    return f"compute capability {compute_capability()}, {processors}, {nvrtc.version()}"


def launch(
    kernel: cubin.Kernel, record: Sequence[jax.ShapeDtypeStruct], horizon: int, *args: jax.Array
) -> Sequence[jax.Array]:
    """Runs a kernel on a GPU; vmapped, it remains one launch.

    Args:
      kernel: of ``loops.play_loop``.
      record: shape and dtype of the observation, the action and the reward of a step.
      horizon: T, the steps of an episode at most.
      args: signed limits [N], keys [N, 2], and the leaves of the actor [...] and of the state
        [N, ...].

    Returns:
      What the kernel does, without the seeds' axis.
    """
    play = in_one_launch(lambda *batch: _launch(kernel, record, horizon, *batch))
    return [x[0] for x in play(*(x[None] for x in args))]


def in_one_launch(run: Callable[..., Sequence[jax.Array]]) -> Callable[..., Sequence[jax.Array]]:
    """Returns ``run``, which is called once also where it is vmapped.

    Args:
      run: arrays [B, ...] -> a list of arrays [B, ...]; vmapped, it is given all examples along B.
    """
    batched_run = jax.custom_batching.custom_vmap(run)

    @batched_run.def_vmap
    def _(size, axes, *args):
        """Joins the mapped axis [size] with the batch axis [B] behind it: one call for all."""
        batch = [
            x if is_mapped else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_mapped in zip(args, axes, strict=True)
        ]
        outputs = batched_run(*(x.reshape(-1, *x.shape[2:]) for x in batch))
        # ``batched_run`` again, not ``run``: an outer vmap finds the same rule.
        return [x.reshape(size, -1, *x.shape[1:]) for x in outputs], [True] * len(outputs)

    return batched_run


def _launch(
    kernel: cubin.Kernel, record: Sequence[jax.ShapeDtypeStruct], horizon: int, *args: jax.Array
) -> Sequence[jax.Array]:
    """Runs a kernel for seeds, whose axis all arguments and results begin with."""
    seeds, episodes = args[0].shape
    # Length, broken, simulated and the next item, in the order of ``loops.RESULTS``.
    counts = (seeds, episodes), (seeds, episodes), (seeds,), (1,)
    zeros = [jnp.zeros((seeds, horizon, math.prod(x.shape), episodes), x.dtype) for x in record]
    zeros += [jnp.zeros(shape, jnp.int32) for shape in counts]
    kernel, grid = _sized(kernel, seeds * episodes)
    sizes = jnp.array([seeds, episodes, horizon], jnp.int32)
    aliases = {1 + len(args) + k: k for k in range(len(zeros))}
    return _call(kernel, grid, [sizes, *args, *zeros], zeros, aliases)[:-1]


def launch_map(
    kernel: cubin.Kernel, shapes: Sequence[jax.ShapeDtypeStruct], *args: jax.Array
) -> Sequence[jax.Array]:
    """Runs a kernel that maps a function; vmapped, it remains one launch.

    Args:
      kernel: of ``loops.map_loop``.
      shapes: shape [N, ...] and dtype of what it returns.
      args: its arguments [N, ...].
    """

    def play(*args):
        """Launches one kernel for all examples."""
        examples = len(args[0])
        sized_kernel, grid = _sized(kernel, examples)
        sizes = jnp.array([examples], jnp.int32)
        batch_shapes = [jax.ShapeDtypeStruct((examples, *x.shape[1:]), x.dtype) for x in shapes]
        aliases = {}
        if sized_kernel.launch.lanes == 1 and loops.is_written_over(args, batch_shapes):
            aliases = {1 + k: k for k in range(len(batch_shapes))}
        return _call(sized_kernel, grid, [sizes, *args], batch_shapes, aliases)

    return in_one_launch(play)(*args)


def _call(
    kernel: cubin.Kernel,
    grid: tuple[int, int],
    arguments: Sequence[jax.Array],
    shapes: Sequence[jax.ShapeDtypeStruct | jax.Array],
    aliases: Mapping[int, int],
) -> Sequence[jax.Array]:
    """Launches blocks of threads; returns what they write.

    If the kernel has scratch, it begins with any values.

    Args:
      kernel: what is launched.
      grid: how many blocks of how many threads.
      arguments: what the kernel reads.
      shapes: shapes and dtypes of the results.
      aliases: the numbers of arguments that the kernel writes results over, and of those results.
        XLA copies an argument that is read later, and no other.
    """
    results = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in shapes)
    pairs = tuple(aliases.items())
    return _LAUNCH.bind(*arguments, kernel=kernel, grid=grid, results=results, aliases=pairs)


def _ffi_call(*arguments: jax.Array, kernel: Any, grid: Any, results: Any, aliases: Any) -> Any:
    """Calls the handler of a kernel, which is compiled from here on."""
    scratch = []
    if words := kernel.launch.scratch * math.prod(grid):
        scratch.append(jax.ShapeDtypeStruct((words,), jnp.int32))
    blocks, threads = map(np.int32, grid)
    target = _handler(kernel)
    call = jax.ffi.ffi_call(target, [*results, *scratch], input_output_aliases=dict(aliases))
    return call(*arguments, blocks=blocks, threads=threads)[: len(results)]


@functools.cache
def _compiled_call(**parameters: Any) -> Callable[..., Any]:
    """Returns what launches a kernel outside of ``jax.jit``."""
    return jax.jit(functools.partial(_ffi_call, **parameters))


#: A launch. Its kernel is compiled where it is lowered, and not where it is traced: ``vmap`` also
#: traces the launch for one seed, of another size and so perhaps of another kernel.
_LAUNCH = core.Primitive("launch")
_LAUNCH.multiple_results = True
_LAUNCH.def_abstract_eval(
    lambda *_, results, **__: [jax.core.ShapedArray(x.shape, x.dtype) for x in results]
)
_LAUNCH.def_impl(lambda *arguments, **parameters: _compiled_call(**parameters)(*arguments))
mlir.register_lowering(_LAUNCH, mlir.lower_fun(_ffi_call, multiple_results=True))


def _sized(kernel: cubin.Kernel, count: int) -> tuple[cubin.Kernel, tuple[int, int]]:
    """Returns the kernel, and how many blocks of how many threads, that play so many items."""
    sized_kernel = team.for_items(kernel, count, _num_processors(), compute_capability())
    launch = sized_kernel.launch
    return sized_kernel, _grid(count * launch.lanes, launch.threads, launch.blocks)


def _grid(num_items: int, limit: int, blocks: int) -> tuple[int, int]:
    """Returns how many blocks of how many threads, at most so many, play so many episodes.

    They are spread over all multiprocessors, each of which has so many blocks at most.
    """
    processors = _num_processors()
    # A block is whole warps. Few episodes get small blocks, so that each multiprocessor has some.
    threads = min(WARP * -(-num_items // (WARP * processors)), limit)
    return min(-(-num_items // threads), blocks * processors), threads
