"""From a design to all that a sweep is made of; nothing is compiled, and bad input is refused.

Its configurations are in groups, and these in chunks that fit into memory; a paragraph says what
that means for people.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.devices import Devices
from mjx_reinforce.reports.experiment import counted
from mjx_reinforce.runs.plan import duration, idle, run_seconds, task_of, this_hardware
from mjx_reinforce.settings.memory import gigabytes, needed, num_cores
from mjx_reinforce.store.build import build, policy_settings
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.designs.grid import configure
from mjx_reinforce.sweeps.designs.groups import Group, make_groups
from mjx_reinforce.types import Environment

#: Chunks take up to this part of the memory that is there.
_MEMORY = 0.6
#: Episodes side by side in a slot of a device; the widest slot first. On two CPU cores a run costs
#: the same beside 7 others or 255, and narrow slots waste less on runs of other lengths. An H200
#: needs 65,536 episodes for most of its speed; for few runs a narrow slot answers sooner.
_CPU_EPISODES = (128,)
_GPU_EPISODES = (65_536, 8_192)


class GroupPlan(NamedTuple):
    """How the runs of a group are divided.

    num_chunks: of about the same size
    widths: runs that a compiled program moves at once, the most first
    """

    num_chunks: int
    widths: tuple[int, ...]


def divide(group: Group, limit: int, num_devices: int, *, exact: bool) -> GroupPlan:
    """Returns how the runs of a group are divided.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      limit: runs in a chunk at most.
      num_devices: among which a chunk is divided.
      exact: one run a slot.
    """
    total = len(group.members) * group.config.num_seeds
    num_chunks = -(-total // limit)
    if exact:
        return GroupPlan(num_chunks, (num_devices,))
    most = -(-total // (num_chunks * num_devices))
    side = _CPU_EPISODES if this_hardware().shared else _GPU_EPISODES
    each = {min(most, -(-count // group.config.episodes_per_update)) for count in side}
    return GroupPlan(num_chunks, tuple(num_devices * width for width in sorted(each, reverse=True)))


def chunk_limit(
    env: Environment,
    horizon: int,
    group: Group,
    asked: int | None,
    num_devices: int,
) -> int:
    """Returns how many runs of a group a chunk may have.

    Args:
      env: what is trained on.
      horizon: the time limit of an episode in steps.
      group: whose runs are divided.
      asked: what the user said, or None for what memory holds.
      num_devices: among which a chunk is divided.

    Raises:
      ValueError: not even one run for each device fits into memory.
    """
    total = len(group.members) * group.config.num_seeds
    limit = _capacity(env, horizon, group, num_devices) if asked is None else asked
    return min(limit, total)


def _capacity(env: Environment, horizon: int, group: Group, num_devices: int) -> int:
    """Returns how many runs memory holds side by side."""
    one = dataclasses.replace(group.config, num_seeds=1)
    task, machine = task_of(policy_settings(env, one), horizon, one), this_hardware()
    memory = machine.memory - task.base_memory if machine.shared else machine.memory * num_devices
    capacity = int(_MEMORY * memory / needed(one, task))
    if capacity < num_devices:
        raise ValueError(
            f"not even one run for each of {num_devices} devices fits into memory: a run needs "
            f"{gigabytes(needed(one, task))}; lower --num-episodes, --eval-episodes or --horizon"
        )
    return capacity


def describe_plan(
    envs: Sequence[Environment],
    horizons: Sequence[int],
    learners: Sequence[Any],
    groups: Sequence[Group],
    parts: Sequence[GroupPlan],
    num_devices: int,
) -> str:
    """Returns a paragraph on what a sweep will do.

    Args:
      envs: what each group trains on.
      horizons: the time limit of an episode in steps, of each group.
      learners: one of each group.
      groups: of configurations.
      parts: how the runs of each are divided.
      num_devices: on which they are.
    """
    first, machine = groups[0].config, this_hardware()
    configurations = sum(len(group.members) for group in groups)
    runs, chunks = configurations * first.num_seeds, sum(part.num_chunks for part in parts)
    at_once = num_cores() if machine.shared else 1  # slots
    side = max(
        -(-len(group.members) * group.config.num_seeds // part.num_chunks)
        for group, part in zip(groups, parts, strict=True)
    )
    memory = max(
        needed(dataclasses.replace(group.config, num_seeds=at_once * part.widths[0]), task)
        for env, horizon, group, part in zip(envs, horizons, groups, parts, strict=True)
        for task in (task_of(policy_settings(env, group.config), horizon, group.config),)
    )
    where = machine.name
    if num_devices > 1:
        where = f"{num_devices} devices" + (f" ({where} each)" if not machine.shared else "")
    return (
        f"Sweeping {configurations:,} configurations of {first.num_seeds:,} seeds, {runs:,} runs "
        f"of {first.env}, on {where}, with the engine {learners[0].engine.name}: "
        f"{counted(len(groups), 'compiled program')}, {counted(chunks, 'chunk')} of up to {side:,} "
        f"runs. {_time(envs, horizons, learners, groups, num_devices)}. "
        f"It needs about {gigabytes(memory)} of memory beside the programs."
        f"{_idle_devices(side, num_devices)}"
    )


def _idle_devices(side: int, num_devices: int) -> str:
    """Returns a sentence where devices stand idle, else nothing.

    Args:
      side: how many runs are under way at once at most.
      num_devices: among which they are divided.
    """
    few = "no more runs are under way at once"
    return idle(min(side, num_devices), few if side < num_devices else "--exact computes on one")


def _time(
    envs: Sequence[Environment],
    horizons: Sequence[int],
    learners: Sequence[Any],
    groups: Sequence[Group],
    num_devices: int,
) -> str:
    """Returns about how long the training takes, where that is known."""
    total = 0.0
    for env, horizon, learner, group in zip(envs, horizons, learners, groups, strict=True):
        seconds = group_seconds(env, horizon, learner.engine.name, group, num_devices)
        if seconds is None:
            return "How long this takes here is not known"
        total += seconds
    compiling = duration(this_hardware().speeds[groups[0].config.env].compiling)
    return f"Compiling takes about {compiling} each, training about {duration(total)}"


def group_seconds(
    env: Environment, horizon: int, engine: str, group: Group, num_devices: int
) -> float | None:
    """Returns about how long all runs of a group train (s), None where that is not known.

    Args:
      env: what is trained on.
      horizon: the time limit of an episode in steps.
      engine: the name of what plays.
      group: of configurations, with their budget.
      num_devices: on which they are.
    """
    machine, num_seeds = this_hardware(), len(group.members) * group.config.num_seeds
    config = dataclasses.replace(group.config, num_seeds=num_seeds)
    speed = machine.speeds.get(config.env)
    if speed is None or engine != speed.engine:
        return None
    task = task_of(policy_settings(env, config), horizon, config)
    seconds, _ = run_seconds(config, task, machine, speed)
    return seconds / (1 if machine.shared else num_devices)


class Prepared(NamedTuple):
    """All that a sweep is made of.

    envs: what each group trains on
    horizons: the time limit of an episode in steps, of each group
    devices: where
    configurations: the values of what is swept, in each
    groups: of configurations
    limits: how many runs of each group a chunk may have
    engine: the name of what plays the episodes
    engine_seconds: wall time that making it took, for all groups
    plan: a paragraph for people
    """

    envs: list[Any]
    horizons: list[int]
    devices: Devices
    configurations: list[dict[str, Any]]
    groups: list[Group]
    limits: list[int]
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
    devices = Devices(1 if design.exact else None)
    groups = make_groups(configs, tuple(design.over), exact=design.exact)
    made = [envs.make_set(group.config.env, group.config.env_set) for group in groups]
    built = [build(env, group.config) for env, group in zip(made, groups, strict=True)]
    learners, horizons = [list(x) for x in zip(*built, strict=True)]
    if limits is None:
        limits = [
            chunk_limit(env, horizon, group, design.chunk_runs, devices.count)
            for env, horizon, group in zip(made, horizons, groups, strict=True)
        ]
    parts = [
        divide(group, limit, devices.count, exact=design.exact)
        for group, limit in zip(groups, limits, strict=True)
    ]
    plan = describe_plan(made, horizons, learners, groups, parts, devices.count)
    engine = learners[0].engine.name, sum(learner.engine.seconds for learner in learners)
    return Prepared(made, horizons, devices, configurations, groups, list(limits), *engine, plan)
