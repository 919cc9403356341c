"""Programs over the devices of this process. The one file that knows ``jax.shard_map``."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.memory import gigabytes, host_memory

_AXIS = "devices"
#: XLA tries kernels for each product of matrices until it has the fastest, and which it takes may
#: differ from run to run. On an H100 Humanoid compiled in 9 s without trials, in 51 s with them.
_GPU_OPTIONS = {"xla_gpu_enable_triton_gemm": False, "xla_gpu_autotune_level": 0}
#: The first axis is divided among the devices, such as that of the runs; the second is; none is.
RUNS = PartitionSpec(_AXIS)
SECOND = PartitionSpec(None, _AXIS)
NONE = PartitionSpec()


def memory_here() -> float:
    """Returns the memory that a device has for arrays (bytes); on a CPU it is the host's."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return host_memory()
    return float((device.memory_stats() or {}).get("bytes_limit", float("inf")))


def bytes_of(shapes: PyTree) -> float:
    """Returns the bytes of arrays, or of their shapes."""
    return float(sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes)))


def check_room(num_bytes: float) -> None:
    """Raises ValueError if so many bytes are not there."""
    memory = memory_here()
    if num_bytes > memory:
        raise ValueError(
            f"this does not fit into memory: it needs about {gigabytes(num_bytes)}, "
            f"{gigabytes(memory)} are here; lower --num-seeds (of a sweep --chunk-runs), --race, "
            "--num-episodes, --eval-episodes, --hidden-sizes, --value-hidden-sizes or --horizon"
        )


def executable(lowered: jax.stages.Lowered, cpu_level: int | None = None) -> jax.stages.Compiled:
    """Returns a compiled program, on a GPU without trials of kernels.

    Args:
      lowered: the program.
      cpu_level: how far XLA optimizes for a CPU, from 0 to 3; None leaves it to XLA.
    """
    options: dict[str, Any] | None = None
    if jax.default_backend() == "gpu":
        options = _GPU_OPTIONS
    elif cpu_level is not None:
        options = {"xla_backend_optimization_level": cpu_level}
    return lowered.compile(compiler_options=options)


class Devices:
    """The devices of this process, among which an axis of arrays is divided."""

    def __init__(self, most: int | None = None):
        """Takes the first ``most`` devices of this process, or all."""
        self.mesh = Mesh(jax.local_devices()[:most], (_AXIS,))
        self.count = self.mesh.size

    def map(self, function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Any:
        """Returns a function that runs on every device, on its own part of what is divided.

        Loops are each device's own: a device that is done waits for the others only where somebody
        reads the results.

        Args:
          function: of arrays that hold one device's part.
          in_specs: for its arguments, how they are divided.
          out_specs: for its result, how it is divided.
        """
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
        )

    def sum(self, x: jax.Array) -> jax.Array:
        """Returns the sum over all devices, within what ``map`` runs."""
        return lax.psum(x, _AXIS)

    def number(self) -> jax.Array:
        """Returns the number [] of the device, within what ``map`` runs."""
        return lax.axis_index(_AXIS)

    def jit(self, function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Any:
        """Returns ``map`` of a function, compiled."""
        # Said again: arrays without entries would else be on all devices.
        shardings = self.shardings(out_specs)
        mapped_function = self.map(function, in_specs, out_specs)
        return jax.jit(mapped_function, out_shardings=shardings)

    def shardings(self, specs: Any) -> Any:
        """Returns how arrays are divided, for JAX."""
        return jax.tree.map(lambda spec: NamedSharding(self.mesh, spec), specs)

    def put(self, tree: PyTree, spec: PartitionSpec) -> Any:
        """Returns arrays divided among the devices."""
        return jax.device_put(tree, NamedSharding(self.mesh, spec))

    def shapes(self, tree: PyTree, spec: PartitionSpec) -> Any:
        """Returns the shapes of arrays that are divided among the devices."""
        sharding = NamedSharding(self.mesh, spec)
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree
        )
