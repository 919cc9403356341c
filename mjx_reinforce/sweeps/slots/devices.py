"""Runs side by side on all devices of this process, each device with loops of its own.

The one file that knows ``jax.shard_map``. Nothing is communicated: a device that is done with a
block waits for the others only where the host reads the results.
"""

from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_reinforce.types import PyTree

_AXIS = "runs"
#: The first axis is that of the runs; none is.
RUNS, NONE = PartitionSpec(_AXIS), PartitionSpec()


class Devices:
    """The devices of this process, among which an axis of runs is divided."""

    def __init__(self, most: int | None = None):
        """Takes the first ``most`` devices of this process, or all."""
        self.mesh = Mesh(jax.local_devices()[:most], (_AXIS,))
        self.count = self.mesh.size

    def jit(
        self, function: Callable[..., Any], in_specs: Any, out_specs: Any, **options: Any
    ) -> Any:
        """Returns a compiled function that runs on every device, on its own part of the axis.

        Args:
          function: of arrays that hold one device's part.
          in_specs: for its arguments, how they are divided.
          out_specs: for its result, how it is divided.
          options: of ``jax.jit``.
        """
        mapped = jax.shard_map(
            function, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
        )
        # Said again: arrays without entries would else be on all devices.
        shardings = jax.tree.map(lambda spec: NamedSharding(self.mesh, spec), out_specs)
        return jax.jit(mapped, out_shardings=shardings, **options)

    def put(self, tree: PyTree, spec: PartitionSpec) -> Any:
        """Returns arrays divided among the devices."""
        return jax.device_put(tree, NamedSharding(self.mesh, spec))

    def shapes(self, tree: PyTree, spec: PartitionSpec) -> Any:
        """Returns the shapes of arrays that are divided among the devices."""
        sharding = NamedSharding(self.mesh, spec)
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree
        )
