"""How the work of a run is divided among the devices of a process.

Where there are as many seeds as devices, or more, each device trains some of the seeds, and says
nothing to the others. Where there are fewer, each plays a part of the episodes of every update of
all seeds, and the sums over episodes are over all devices. Neither changes a number but by
rounding: the keys of an episode follow from its seed and its own number.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import PartitionSpec

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.devices import NONE, RUNS, Devices
from mjx_reinforce.engine.play.episode import largest_divisor
from mjx_reinforce.registry import find_algorithm, is_own
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.state import RunState, shape_of_all

#: Episodes are divided among GPUs only where each plays so many of an update, of all seeds: fewer
#: take as long as these. Devices of a CPU are there because the user made them.
_LEAST = 1024


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
        return _devices(self.count)

    def width(self, num_seeds: int) -> int:
        """Returns how many of the seeds a device has at most."""
        return -(-num_seeds // self.seeds)

    def of_each(self, config: Config, num_seeds: int) -> Config:
        """Returns the settings of what each device does of so many seeds."""
        config = dataclasses.replace(config, num_seeds=self.width(num_seeds))
        if self.episodes == 1:
            return config
        return dataclasses.replace(config, num_episodes=config.num_episodes // self.episodes)

    def jit(
        self,
        function: Callable[..., Any],
        in_specs: tuple[PartitionSpec, ...],
        out_specs: Any,
        *,
        by_episodes: bool = False,
        **options: Any,
    ) -> Any:
        """Returns a compiled function of seeds on these devices.

        Args:
          function: of arrays, of some or all seeds.
          in_specs: which axis of its arguments is that of the seeds.
          out_specs: the same of its result.
          by_episodes: whether it divides episodes itself.
          options: of ``jax.jit``.
        """
        if self.count == 1:
            return jax.jit(function, **options)
        devices = self.devices()
        if self.seeds > 1:
            return devices.jit(function, in_specs, out_specs, **options)
        everywhere = devices.shardings(NONE)
        if by_episodes:
            shardings = {"in_shardings": everywhere, "out_shardings": everywhere}
            return jax.jit(function, **shardings, **options)
        return devices.jit(function, NONE, NONE, **options)

    def shapes(self, like: RunState, num_seeds: int) -> RunState:
        """Returns the shapes of all seeds' states as ``place`` puts them, from those of some."""
        total = self.seeds * self.width(num_seeds)
        shapes = shape_of_all(like, total)
        if self.count == 1:
            return shapes
        return self.devices().shapes(shapes, RUNS if self.seeds > 1 else NONE)

    def place(self, tree: PyTree, spec: PartitionSpec = RUNS) -> Any:
        """Returns arrays for a function of ``jit``; the last seed stands where there is no other.

        Args:
          tree: arrays, of which the seeds are the first axis.
          spec: RUNS, or NONE where no axis is that of seeds.
        """
        if self.count == 1:
            return tree
        devices = self.devices()
        if self.seeds == 1 or spec == NONE:
            return devices.put(tree, NONE)
        num_seeds = len(jax.tree.leaves(tree)[0])
        if num_seeds % self.seeds:
            total = self.seeds * self.width(num_seeds)
            return _rows(devices, total, RUNS)(devices.put(tree, NONE))
        return devices.put(tree, RUNS)

    def view(self, tree: PyTree, num_seeds: int) -> Any:
        """Returns what ``place`` was given, or a function of ``jit`` made of it."""
        if self.seeds == 1 or num_seeds % self.seeds == 0:
            return tree
        return _rows(self.devices(), num_seeds, NONE)(tree)


_devices = functools.cache(Devices)


@functools.cache
def _rows(devices: Devices, count: int, spec: PartitionSpec) -> Callable[[PyTree], Any]:
    """Returns a function to the first rows of arrays, with the last again where there are fewer."""

    def rows(tree: PyTree) -> Any:
        return jax.tree.map(lambda x: x[np.minimum(np.arange(count), len(x) - 1)], tree)

    return jax.jit(rows, out_shardings=devices.shardings(spec))


#: One device trains.
ALONE = Division()


def divide_run(config: Config) -> Division:
    """Returns how a run is divided among the devices of this process.

    Args:
      config: its settings.
    """
    here, num_seeds = jax.local_device_count(), config.num_seeds
    width = -(-num_seeds // here)
    by_seeds = Division(seeds=-(-num_seeds // width))
    if find_algorithm(config.algorithm).search_episodes or is_own(config.algorithm):
        return by_seeds
    episodes = largest_divisor(config.num_episodes, here)
    each = num_seeds * config.episodes_per_update / episodes
    enough = each >= _LEAST or jax.default_backend() == "cpu"
    # How many seeds' episodes a device plays, by either.
    return Division(episodes=episodes) if enough and num_seeds / episodes < width else by_seeds
