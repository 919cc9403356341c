"""From a design to all that a run or a sweep is made of; nothing is compiled.

Configurations are in groups that share their programs, and these in chunks that fit into memory. A
run is one configuration, whose seeds are one chunk in one slot.
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce.engine.base import Environment
from mjx_reinforce.engine.memory import host_memory
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.registry import find_algorithm, is_own
from mjx_reinforce.reports.experiment import counted
from mjx_reinforce.runs.design import Design
from mjx_reinforce.settings.config import Config, is_read, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.settings.defaults import num_cores
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.setup.provenance import provenance
from mjx_reinforce.setup.ready import Ready, load_or_build_ready
from mjx_reinforce.training import resume
from mjx_reinforce.training.division import Division
from mjx_reinforce.training.driver import Runs
from mjx_reinforce.training.resume import Checkpoint
from mjx_reinforce.training.slots import Stopwatch
from mjx_reinforce.training.state import StateRows, last_actors


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
    ready: what their programs are made of
    limit: how many of its runs a chunk may have
    width: runs that a compiled program moves at once
    chunks: its runs, in parts of about the same size
    """

    group: Group
    ready: Ready
    limit: int
    width: int
    chunks: list[Runs]


class Plan(NamedTuple):
    """All that a run or a sweep is made of.

    design: what it is to do
    parts: its groups
    division: among which devices the runs are divided
    known: what the first file of its directory says, if it goes on
    found: the checkpoint from which a run goes on, if any
    actors: with which a run begins, if those of another
    clock: counts the time since this was asked for
    """

    design: Design
    parts: list[Part]
    division: Division
    known: Mapping[str, Any]
    found: Checkpoint | None
    actors: Actor | None
    clock: Stopwatch

    @property
    def alone(self) -> bool:
        """Whether it is a run, which is one configuration."""
        return not self.design.over


def make_plan(
    design: Design,
    known: Mapping[str, Any],
    env: Environment | None,
    say: Callable[[str], None],
) -> Plan:
    """Returns what a run or a sweep is made of.

    Args:
      design: of it.
      known: what the first file of its directory says, if it goes on.
      env: the environment of a run, if it is built already.
      say: shows a line to the user.

    Raises:
      ValueError: settings do not fit the environment, or it cannot go on here.
    """
    clock, found = Stopwatch(), None
    if design.base.resume is not None:
        resume.check_same_program(design.directory, known, provenance())
        found = None if design.over else resume.newest_checkpoint(design.base, say)
    if design.over:
        return Plan(design, *_plan_sweep(design, known), known, None, None, clock)
    config, division, actors = design.base, divide_run(design.base), None
    ready = load_or_build_ready(config, design.default or config, env, division)
    if config.init_from is not None and found is None:
        actors = last_actors(config, ready.policy)
    config = dataclasses.replace(config, horizon=ready.horizon)
    group, width = Group(config, np.zeros(1, int), {}), division.capacity(config.num_seeds)
    part = Part(group, ready, config.num_seeds, width, split_runs(group, "000", 1))
    return Plan(design, [part], division, known, found, actors, clock)


#: Episodes are divided among GPUs only where each plays so many of an update, of all seeds: fewer
#: take as long as these. Devices of a CPU are there because the user made them.
_LEAST = 1024
#: XLA of this JAX ends the process on a CPU's devices as it divides arrays without entries, such as
#: the constants of a categorical policy. Where whole seeds are divided it has none to divide.
_DIVIDES_NO_EPISODES = "0.11.2"


def divide_run(config: Config) -> Division:
    """Returns how a run is divided among the devices of this process.

    Args:
      config: its settings.
    """
    here, num_seeds = jax.local_device_count(), config.num_seeds
    width = -(-num_seeds // here)
    by_seeds = Division(seeds=-(-num_seeds // width))
    on_cpu = jax.default_backend() == "cpu"
    if on_cpu and jax.__version__ == _DIVIDES_NO_EPISODES:
        return by_seeds
    if find_algorithm(config.algorithm).search_episodes or is_own(config.algorithm):
        return by_seeds
    episodes = max(n for n in range(1, here + 1) if config.num_episodes % n == 0)
    each = num_seeds * config.episodes_per_update / episodes
    enough = each >= _LEAST or on_cpu
    # How many seeds' episodes a device plays, by either.
    return Division(episodes=episodes) if enough and num_seeds / episodes < width else by_seeds


def _plan_sweep(design: Design, known: Mapping[str, Any]) -> tuple[list[Part], Division]:
    """Returns the groups of a sweep, and what divides them.

    ``known`` is its sweep.json, if it goes on.
    """
    # A program for several devices need not round as the one for a single device does.
    division = Division(seeds=1 if design.exact else jax.local_device_count())
    old = known.get("local_devices", division.count)
    if old != division.count:
        raise ValueError(
            f"{design.directory} was begun on {old} devices, and here are {division.count}; go on "
            "with as many"
        )
    parts = []
    for number, group in enumerate(make_groups(design)):
        config, traced = group.config, tuple(group.settings)
        chosen = vars(config).keys() & {*design.given, *design.over}
        unset = {name: None for name in chosen if is_read(name, config)}
        default: Any = dataclasses.replace(config, **unset)
        ready = load_or_build_ready(config, default, division=division, traced=traced)
        part, limit = Part(group, ready, 0, 0, []), design.chunk_runs
        if known:
            limit = known["chunk_runs"][number]
        elif limit is None:
            limit = max(_capacity(part), division.count)
        limit = limit if known else min(limit, group.num_runs)
        count, width = divide(group, limit, division.count, exact=design.exact)
        chunks = split_runs(group, f"{number:03d}", count)
        parts.append(part._replace(limit=limit, width=width, chunks=chunks))
    return parts, division


def make_groups(design: Design) -> list[Group]:
    """Returns the configurations of a sweep in groups, in the order of their first members.

    Where it is exact, every number is traced that may be, so that what is swept beside it changes
    no program.
    """
    members: dict[Any, list[int]] = {}
    configs = design.configs
    traced = [_traced(config, design.over, design.exact) for config in configs]
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


#: The states of a chunk take up to this part of the host's memory, with copies of them. So few runs
#: are one chunk whatever they take: to know that takes a second a group.
_MEMORY, _COPIES, _FEW = 0.6, 5, 256
#: Episodes side by side in a slot of a device. On two CPU cores a run costs the same beside 7
#: others or 255, and narrow slots waste less on runs of other lengths. An H200 needs 65,536 for
#: most of its speed.
_CPU_EPISODES, _GPU_EPISODES = 128, 65_536


def divide(group: Group, limit: int, num_devices: int, *, exact: bool) -> tuple[int, int]:
    """Returns ``num_chunks`` and the ``width`` of a part.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      limit: runs in a chunk at most.
      num_devices: among which a chunk is divided.
      exact: one run a slot.
    """
    total = group.num_runs
    num_chunks = -(-total // limit)
    if exact:
        return num_chunks, num_devices
    most = -(-total // (num_chunks * num_devices))
    side = _CPU_EPISODES if jax.default_backend() == "cpu" else _GPU_EPISODES
    return num_chunks, num_devices * min(most, -(-side // group.config.episodes_per_update))


def split_runs(group: Group, name: str, num_chunks: int) -> list[Runs]:
    """Returns the runs of a group in chunks, all of one size except the last.

    Seeds come before configurations, so that every chunk has its share of each configuration and
    all take about as long.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      name: of the group, for the files.
      num_chunks: how many.
    """
    total = len(group.members) * group.config.num_seeds
    size = -(-total // num_chunks)
    runs = np.arange(total)
    seed, place = np.divmod(runs, len(group.members))
    seed += group.config.first_seed
    return [
        Runs(f"{name}-{i:04d}", place[part], group.members[place[part]], seed[part])
        for i, part in enumerate(runs[start : start + size] for start in range(0, total, size))
    ]


def _capacity(part: Part) -> int:
    """Returns how many runs of a group may be under way, as memory holds their states."""
    if part.group.num_runs <= _FEW:
        return _FEW
    size = StateRows(part.ready.programs().like).size
    return max(1, int(_MEMORY * host_memory() / (_COPIES * size)))


def describe(plan: Plan) -> str:
    """Returns a sentence on what a run or a sweep will do on this machine."""
    parts, first, ready = plan.parts, plan.parts[0].group.config, plan.parts[0].ready
    what, said = f"{counted(first.num_seeds, 'seed')} of {first.env}", ""
    if not plan.alone:
        runs = [len(runs.seed) for part in parts for runs in part.chunks]
        what = f"{counted(plan.design.count(), 'configuration')} of {what}, {sum(runs):,} runs,"
        said = (
            f"; {counted(len(parts), 'compiled program')}, {counted(len(runs), 'chunk')} of up to "
            f"{max(runs):,} runs"
        )
    return (
        f"Training {what} by {first.algorithm}, {_budget(first)}, on {_where(plan.division)}, "
        f"with the engine {ready.engine}: {ready.why}{said}."
    )


def _budget(config: Config) -> str:
    """Returns for how long each seed is trained."""
    asked = {"minutes": "min together", "max_updates": "updates each"}
    if config.minutes is None:
        asked["env_steps"] = "env steps each"
    budgets = {unit: getattr(config, name) for name, unit in asked.items()}
    return " or ".join(f"{x:,} {unit}" for unit, x in budgets.items() if x is not None)


def _where(division: Division) -> str:
    """Returns which devices compute, of how many here."""
    here, kind = jax.local_device_count(), jax.local_devices()[0].device_kind
    if here == 1:
        return counted(num_cores(), "CPU core") if kind == "cpu" else f"one {kind}"
    shared = "seeds" if division.seeds > 1 else "episodes of an update"
    which = f", which share the {shared}" if division.count > 1 else ""
    return f"{division.count} of the {here} devices here ({kind}){which}"
