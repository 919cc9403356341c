"""From a design to all that a sweep is made of; nothing is compiled, and bad input is refused.

Its configurations are in groups, and these in chunks that fit into memory; a paragraph says what
that means for people.
"""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.engine.base import Environment
from mjx_reinforce.engine.memory import gigabytes
from mjx_reinforce.registry import is_own
from mjx_reinforce.reports.experiment import counted
from mjx_reinforce.runs.plan import devices_in_words, needed, task_of, this_hardware
from mjx_reinforce.settings.config import Config, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.settings.defaults import num_cores
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.settings.tables import Task
from mjx_reinforce.store.build import build, policy_settings
from mjx_reinforce.sweeps.design import Design, configure
from mjx_reinforce.training.division import Division


class Group(NamedTuple):
    """C configurations that share their programs.

    config: the settings of the first
    members: [C] their numbers in the sweep
    settings: [C] each, the numbers that are traced
    """

    config: Config
    members: np.ndarray
    settings: dict[str, np.ndarray]

    @property
    def num_runs(self) -> int:
        """How many runs it has: each configuration has as many seeds."""
        return len(self.members) * self.config.num_seeds


class Part(NamedTuple):
    """A group that is ready to be trained.

    group: its configurations
    env: what they train on
    horizon: the time limit of an episode in steps
    limit: how many of its runs a chunk may have
    num_chunks: in which they are, of about the same size
    widths: runs that a compiled program moves at once, the most first
    """

    group: Group
    env: Environment
    horizon: int
    limit: int
    num_chunks: int
    widths: tuple[int, ...]


def make_groups(configs: Sequence[Config], swept: Collection[str], *, exact: bool) -> list[Group]:
    """Returns the configurations of a sweep in groups, in the order of their first members.

    Args:
      configs: of the sweep.
      swept: the settings in which they differ.
      exact: trace every number that may be, so that what is swept beside it changes no program.
    """
    members: dict[Any, list[int]] = {}
    traced = [_traced(config, swept, exact) for config in configs]
    for number, (config, settings) in enumerate(zip(configs, traced, strict=True)):
        compiled = dataclasses.replace(config, **dict.fromkeys(settings, None))
        members.setdefault((dataclasses.astuple(compiled), tuple(settings)), []).append(number)
    return [
        Group(
            configs[numbers[0]],
            np.array(numbers),
            {name: np.array([traced[i][name] for i in numbers]) for name in traced[numbers[0]]},
        )
        for numbers in members.values()
    ]


def _traced(config: Config, swept: Collection[str], exact: bool) -> dict[str, float]:
    """Returns the numbers of a configuration that its programs take as arguments."""
    if is_own(config.algorithm):
        return {}
    names = set(marked(Mark.TRACED))
    for reader in (Reader.GRADIENT, Reader.REINFORCE):
        names.difference_update(() if reader.holds(config) else marked(reader))
    if not (Reader.REINFORCE.holds(config) and Reader.FREE_STD.holds(config)):
        # Others have ``initial_std`` in their actions, which an engine may compile.
        names.discard("initial_std")
    settings = {name: getattr(config, name) for name in sorted(names) if exact or name in swept}
    if not Reader.DECAY.holds(config):
        settings.pop("final_learning_rate", None)
    elif "learning_rate" in settings and config.final_learning_rate is None:
        settings["final_learning_rate"] = config.learning_rate / 10
    return {
        name: float(value)
        for name, value in settings.items()
        if not (value is None or isinstance(value, str))
    }


def learner_builder(env: Environment, config: Config) -> Callable[[dict[str, Any]], Any]:
    """Returns the function from the traced settings of a run to its learner.

    Args:
      env: what it learns on.
      config: the other settings.
    """
    if config.algorithm != "reinforce":
        return lambda settings: build(env, dataclasses.replace(config, **settings))[0]
    plain = build(env, config)[0]

    def build_learner(settings: dict[str, Any]) -> Any:
        # How REINFORCE plays depends on no traced number, and takes a second to write out.
        traced = build(env, dataclasses.replace(config, engine="vmap", **settings))[0]
        return plain._replace(init=traced.init, learn=traced.learn)

    return build_learner


#: Chunks take up to this part of the memory that is there.
_MEMORY = 0.6
#: Episodes side by side in a slot of a device; the widest slot first. On two CPU cores a run costs
#: the same beside 7 others or 255, and narrow slots waste less on runs of other lengths. An H200
#: needs 65,536 episodes for most of its speed; for few runs a narrow slot answers sooner.
_CPU_EPISODES = (128,)
_GPU_EPISODES = (65_536, 8_192)


def divide(
    group: Group, limit: int, num_devices: int, *, exact: bool
) -> tuple[int, tuple[int, ...]]:
    """Returns ``num_chunks`` and ``widths`` of a part.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      limit: runs in a chunk at most.
      num_devices: among which a chunk is divided.
      exact: one run a slot.
    """
    total = group.num_runs
    num_chunks = -(-total // limit)
    if exact:
        return num_chunks, (num_devices,)
    most = -(-total // (num_chunks * num_devices))
    side = _CPU_EPISODES if this_hardware().shared else _GPU_EPISODES
    each = {min(most, -(-count // group.config.episodes_per_update)) for count in side}
    return num_chunks, tuple(num_devices * width for width in sorted(each, reverse=True))


def _capacity(group: Group, task: Task, num_devices: int) -> int:
    """Returns how many runs of a group memory holds side by side.

    Raises:
      ValueError: not even one run for each device fits into memory.
    """
    one, machine = dataclasses.replace(group.config, num_seeds=1), this_hardware()
    memory = machine.memory - task.base_memory if machine.shared else machine.memory * num_devices
    capacity = int(_MEMORY * memory / needed(one, task))
    if capacity < num_devices:
        raise ValueError(
            f"not even one run for each of {num_devices} devices fits into memory: a run needs "
            f"{gigabytes(needed(one, task))}; lower --num-episodes, --eval-episodes or --horizon"
        )
    return capacity


def _task(env: Environment, horizon: int, config: Config) -> Task:
    return task_of(policy_settings(env, config), horizon, config)


def _describe(parts: Sequence[Part], engine: str, num_devices: int) -> str:
    """Returns a paragraph on what a sweep will do.

    Args:
      parts: its groups.
      engine: the name of what plays the episodes.
      num_devices: on which they are.
    """
    groups, machine = [part.group for part in parts], this_hardware()
    first, at_once = groups[0].config, num_cores() if machine.shared else 1  # slots
    configurations = sum(len(group.members) for group in groups)
    runs, chunks = sum(group.num_runs for group in groups), sum(part.num_chunks for part in parts)
    side, memory = 0, 0.0
    for part in parts:
        config = part.group.config
        side = max(side, -(-part.group.num_runs // part.num_chunks))
        together = dataclasses.replace(config, num_seeds=at_once * part.widths[0])
        memory = max(memory, needed(together, _task(part.env, part.horizon, config)))
    where = machine.name if num_devices == 1 else devices_in_words(num_devices, machine)
    return (
        f"Sweeping {configurations:,} configurations of {first.num_seeds:,} seeds, {runs:,} runs "
        f"of {first.env}, on {where}, with the engine {engine}: "
        f"{counted(len(groups), 'compiled program')}, {counted(chunks, 'chunk')} of up to {side:,} "
        f"runs. It needs about {gigabytes(memory)} of memory beside the programs."
    )


class Prepared(NamedTuple):
    """All that a sweep is made of.

    parts: its groups
    division: among which devices the runs are divided
    configurations: the values of what is swept, in each
    engine: the name of what plays the episodes
    engine_seconds: wall time that making it took, for all groups
    plan: a paragraph for people
    """

    parts: list[Part]
    division: Division
    configurations: list[dict[str, Any]]
    engine: str
    engine_seconds: float
    plan: str


def prepare_sweep(design: Design, limits: Sequence[int] | None) -> Prepared:
    """Returns what a sweep is made of.

    Args:
      design: of the sweep.
      limits: how many runs of each group a chunk may have, if the sweep goes on.

    Raises:
      ValueError: settings do not fit the environment, or a run does not fit into memory.
    """
    configurations = design.configurations()
    configs = configure(design.base, configurations)
    # A program for several devices need not round as the one for a single device does.
    division = Division(seeds=1 if design.exact else jax.local_device_count())
    parts, engines = [], []
    for number, group in enumerate(make_groups(configs, tuple(design.over), exact=design.exact)):
        env = envs.make_set(group.config.env, group.config.env_set)
        learner, horizon = build(env, group.config)
        engines.append(learner.engine)
        limit = design.chunk_runs if limits is None else limits[number]
        if limit is None:
            limit = _capacity(group, _task(env, horizon, group.config), division.count)
        if limits is None:
            limit = min(limit, group.num_runs)
        chunks = divide(group, limit, division.count, exact=design.exact)
        parts.append(Part(group, env, horizon, limit, *chunks))
    engine, seconds = engines[0].name, sum(each.seconds for each in engines)
    plan = _describe(parts, engine, division.count)
    return Prepared(parts, division, configurations, engine, seconds, plan)
