"""How the work of a run is divided among the devices of a process.

Where there are as many seeds as devices, or more, each device trains some of the seeds, and says
nothing to the others. Where there are fewer, each plays some of the episodes of every update of
all seeds, and the sums over episodes are over all devices. Neither changes a number but by
rounding: the keys of an episode follow from its seed and its own number.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import PartitionSpec

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.devices import NONE, RUNS, Devices


@dataclasses.dataclass(frozen=True)
class Division:
    """Among how many devices a run is divided; one of both is 1.

    seeds: of S seeds, each device has as many as the others, or less
    episodes: of the episodes of an update, each device plays as many as the others
    """

    seeds: int = 1
    episodes: int = 1

    @property
    def count(self) -> int:
        """How many devices train."""
        return max(self.seeds, self.episodes)

    def devices(self) -> Devices:
        """Returns these devices, the first of this process."""
        return _first_devices(self.count)

    def width(self, num_seeds: int) -> int:
        """Returns how many of the seeds a device has at most."""
        return -(-num_seeds // self.seeds)

    def capacity(self, num_seeds: int) -> int:
        """Returns how many seeds all devices have room for, of so many; some stay empty."""
        return self.seeds * self.width(num_seeds)

    def jit(
        self,
        program: Callable[..., Any],
        in_specs: tuple[PartitionSpec, ...],
        out_specs: Any,
        *,
        by_episodes: bool = False,
    ) -> Any:
        """Returns a compiled function of seeds on these devices.

        Args:
          program: of arrays, of some or all seeds.
          in_specs: which axis of its arguments is that of the seeds.
          out_specs: the same of its result.
          by_episodes: whether it divides episodes itself.
        """
        # On one device nothing is divided, and a program needs no shardings.
        if self.count == 1:
            return jax.jit(program)
        devices = self.devices()
        # Each device computes its own seeds, and none waits for another.
        if self.seeds > 1:
            return devices.jit(program, in_specs, out_specs)
        # All devices get all seeds. A function that divides episodes maps that alone over them;
        # XLA divides what follows from the episodes.
        replicas = devices.shardings(NONE)
        if by_episodes:
            shardings = {"in_shardings": replicas, "out_shardings": replicas}
            return jax.jit(program, **shardings)
        return devices.jit(program, NONE, NONE)

    def shapes(self, shape_tree: PyTree, spec: PartitionSpec) -> Any:
        """Returns the shapes of arrays as ``put`` places them."""
        if self.count == 1:
            return shape_tree
        return self.devices().shapes(shape_tree, self._spec(spec))

    def put(self, array_tree: PyTree, spec: PartitionSpec = RUNS) -> Any:
        """Returns arrays for a function of ``jit``.

        Args:
          array_tree: arrays.
          spec: RUNS where their first axis is that of the seeds, NONE where none is.
        """
        if self.count == 1:
            return array_tree
        return self.devices().put(array_tree, self._spec(spec))

    def _spec(self, spec: PartitionSpec) -> PartitionSpec:
        return spec if self.seeds > 1 else NONE


_first_devices = functools.cache(Devices)

#: One device trains.
ALONE = Division()
