"""From a design to all that a run or a sweep is made of; nothing is compiled.

Configurations are in groups that share their programs, and these in chunks that fit into memory. A
run is one configuration, whose seeds are one chunk in one slot.
"""

import dataclasses
import itertools
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
from mjx_reinforce.statistics.sequential import look_seeds
from mjx_reinforce.training import resume
from mjx_reinforce.training.division import Division
from mjx_reinforce.training.driver import Runs
from mjx_reinforce.training.resume import Checkpoint
from mjx_reinforce.training.slots import Stopwatch
from mjx_reinforce.training.state import last_actors


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
        """How many runs it has: each configuration has as many seeds, and each of these a race."""
        return len(self.members) * self.config.num_policies


class GroupPlan(NamedTuple):
    """How a group is trained.

    group: its configurations
    ready: what their programs are made of
    limit: how many of its runs a chunk may have
    width: runs that a compiled program moves at once
    stages: its runs in chunks, all of about the same size; of one stage, but where a sweep looks
      at its results after each
    """

    group: Group
    ready: Ready
    limit: int
    width: int
    stages: list[list[Runs]]

    @property
    def chunks(self) -> list[Runs]:
        """The chunks of all stages."""
        return [runs for chunks in self.stages for runs in chunks]


class Plan(NamedTuple):
    """All that a run or a sweep is made of.

    design: what it is to do
    group_plans: how each of its groups is trained
    division: among which devices the runs are divided
    saved_record: what the first file of its directory says, if it goes on
    checkpoint: from which a run goes on, if there is one
    actors: with which a run begins, if those of another
    clock: counts the time since this was asked for
    """

    design: Design
    group_plans: list[GroupPlan]
    division: Division
    saved_record: Mapping[str, Any]
    checkpoint: Checkpoint | None
    actors: Actor | None
    clock: Stopwatch


def make_plan(
    design: Design,
    saved_record: Mapping[str, Any],
    env: Environment | None,
    say: Callable[[str], None],
) -> Plan:
    """Returns what a run or a sweep is made of.

    Args:
      design: of it.
      saved_record: what the first file of its directory says, if it goes on.
      env: the environment of a run, if it is built already.
      say: shows a line to the user.

    Raises:
      ValueError: settings do not fit the environment, or it cannot go on here.
    """
    clock = Stopwatch()
    config = design.base
    checkpoint = None
    if config.resume is not None:
        resume.check_same_program(design.directory, saved_record, provenance())
        # A sweep has checkpoints, too, but one a chunk: its files look for them as it gets there.
        if not design.is_sweep:
            checkpoint = resume.newest_checkpoint(config, say)
    if design.is_sweep:
        group_plans, division = _plan_sweep(design, saved_record)
        return Plan(design, group_plans, division, saved_record, None, None, clock)
    division = divide_run(config)
    ready_programs = load_or_build_ready(
        config,
        design.default or config,
        env,
        division,
        played_by=saved_record.get("played_by"),
    )
    actors = None
    # The policies of a checkpoint began with those of the other run, and have learned since.
    if config.init_from is not None and checkpoint is None:
        actors = last_actors(config, ready_programs.policy)
    # As config.json will say it: the run then goes on with this time limit, also in a later
    # version, where the task's own may be another.
    config = dataclasses.replace(config, horizon=ready_programs.horizon)
    group = Group(config, members=np.zeros(1, int), settings={})
    group_plan = GroupPlan(
        group=group,
        ready=ready_programs,
        limit=config.num_policies,
        width=division.capacity(config.num_policies),
        stages=[split_runs(group, "000", 1)],
    )
    return Plan(design, [group_plan], division, saved_record, checkpoint, actors, clock)


#: Episodes are divided among GPUs only where each plays so many of an update, of all seeds: fewer
#: take as long as these. Devices of a CPU are there because the user made them.
_MIN_EPISODES = 1024
#: XLA of this JAX ends the process on a CPU's devices as it divides arrays without entries, such as
#: the constants of a categorical policy. Where whole seeds are divided it has none to divide.
_DIVIDES_NO_EPISODES = "0.11.2"


def divide_run(config: Config) -> Division:
    """Returns how a run is divided among the devices of this process.

    Args:
      config: its settings.
    """
    num_devices = jax.local_device_count()
    num_policies = config.num_policies
    # Policies a device, and from that the devices: of 5 policies on 4 devices two each, on three.
    policies_per_device = -(-num_policies // num_devices)
    seed_division = Division(seeds=-(-num_policies // policies_per_device))
    is_cpu = jax.default_backend() == "cpu"
    if is_cpu and jax.__version__ == _DIVIDES_NO_EPISODES:
        return seed_division
    # Only the learners of this package that follow a gradient sum it over the devices.
    if find_algorithm(config.algorithm).search_episodes or is_own(config.algorithm):
        return seed_division
    # Every device plays as many episodes of an update.
    num_episode_devices = max(
        device_count
        for device_count in range(1, num_devices + 1)
        if config.num_episodes % device_count == 0
    )
    episodes_per_device = num_policies * config.episodes_per_update / num_episode_devices
    has_enough_episodes = episodes_per_device >= _MIN_EPISODES or is_cpu
    # Both sides say how many policies' episodes a device plays, and the lower one takes less time.
    if has_enough_episodes and num_policies / num_episode_devices < policies_per_device:
        return Division(episodes=num_episode_devices)
    return seed_division


def _plan_sweep(
    design: Design, saved_record: Mapping[str, Any]
) -> tuple[list[GroupPlan], Division]:
    """Returns how the groups of a sweep are trained, and what divides them.

    Args:
      design: of the sweep.
      saved_record: its sweep.json, if it goes on.

    Raises:
      ValueError: it goes on, and was begun on another number of devices.
    """
    # A program for several devices need not round as the one for a single device does.
    division = Division(seeds=1 if design.exact else jax.local_device_count())
    num_saved_devices = saved_record.get("local_devices", division.count)
    if num_saved_devices != division.count:
        raise ValueError(
            f"{design.directory} was begun on {num_saved_devices} devices, and here are "
            f"{division.count}; go on with as many"
        )
    group_plans = []
    for group_number, group in enumerate(make_groups(design)):
        config = group.config
        # Refused is what the policy does not read and differs from the default. Here that is what
        # the user chose or sweeps, unless this configuration does not read it in any case.
        chosen_names = vars(config).keys() & {*design.chosen_names, *design.over}
        unset_values = {name: None for name in chosen_names if is_read(name, config)}
        default: Any = dataclasses.replace(config, **unset_values)
        played_by = None
        if "played_by" in saved_record:
            played_by = saved_record["played_by"][group_number]
        ready_programs = load_or_build_ready(
            config,
            default,
            division=division,
            traced=tuple(group.settings),
            played_by=played_by,
        )
        # A sweep that goes on has the chunks that it had, by whose names their files are found,
        # whatever memory there is here.
        if saved_record:
            max_chunk_runs = saved_record["chunk_runs"][group_number]
        elif design.chunk_runs is not None:
            max_chunk_runs = min(design.chunk_runs, group.num_runs)
        else:
            max_chunk_runs = min(
                max(_capacity(group, ready_programs), division.count), group.num_runs
            )
        name = f"{group_number:03d}"
        parts = {name: group}
        if design.until_decided:
            parts = _split_seeds(group, name)
        divisions = {
            name: divide(part, max_chunk_runs, division.count, exact=design.exact)
            for name, part in parts.items()
        }
        stages = [split_runs(parts[name], name, divisions[name][0]) for name in parts]
        slot_width = max(width for _, width in divisions.values())
        group_plans.append(GroupPlan(group, ready_programs, max_chunk_runs, slot_width, stages))
    return group_plans, division


def _split_seeds(group: Group, name: str) -> dict[str, Group]:
    """Returns a group with the seeds of one stage at a time, by names of their own."""
    parts = {}
    for start, end in itertools.pairwise([0, *look_seeds(group.config.num_seeds)]):
        config = dataclasses.replace(group.config, seeds=f"{start}:{end}", num_seeds=end - start)
        parts[f"{name}-{len(parts)}"] = group._replace(config=config)
    return parts


def make_groups(design: Design) -> list[Group]:
    """Returns the configurations of a sweep in groups, in the order of their first members.

    Where it is exact, every number is traced that may be, so that what is swept beside it changes
    no program.
    """
    numbers_of_programs: dict[Any, list[int]] = {}
    configs = design.configs
    traced_settings = [_traced(config, design.over, design.exact) for config in configs]
    for number, (config, settings) in enumerate(zip(configs, traced_settings, strict=True)):
        # Two that differ in traced numbers alone are equal once these are taken out.
        compiled_config = dataclasses.replace(config, **dict.fromkeys(settings, None))
        numbers_of_programs.setdefault(
            (dataclasses.astuple(compiled_config), tuple(settings)), []
        ).append(number)
    return [
        Group(
            configs[member_numbers[0]],
            np.array(member_numbers),
            {
                name: np.array([traced_settings[member][name] for member in member_numbers])
                for name in traced_settings[member_numbers[0]]
            },
        )
        for member_numbers in numbers_of_programs.values()
    ]


def _traced(config: Config, swept: Collection[str], exact: bool) -> dict[str, float]:
    """Returns the numbers of a configuration that its programs take as arguments."""
    if is_own(config.algorithm):
        return {}
    traceable_names = set(marked(Mark.TRACED))
    for reader in (Reader.GRADIENT, Reader.REINFORCE):
        traceable_names.difference_update(() if reader.holds(config) else marked(reader))
    if not (Reader.REINFORCE.holds(config) and Reader.FREE_STD.holds(config)):
        # Others have ``initial_std`` in their actions, which an engine may compile.
        traceable_names.discard("initial_std")
    settings = {
        name: getattr(config, name) for name in sorted(traceable_names) if exact or name in swept
    }
    if not Reader.DECAY.holds(config):
        settings.pop("final_learning_rate", None)
    elif "learning_rate" in settings and config.final_learning_rate is None:
        settings["final_learning_rate"] = config.learning_rate / 10
    return {
        name: float(value)
        for name, value in settings.items()
        if not (value is None or isinstance(value, str))
    }


#: The states of a chunk take up to this part of the host's memory.
_MEMORY_SHARE = 0.6
#: So many copies of the states are there at once.
_NUM_COPIES = 5
#: So few runs are one chunk whatever they take: to know that takes a second a group.
_MIN_CHUNK_RUNS = 256
#: Episodes side by side in a slot of a CPU. On two cores a run costs the same beside 7 others or
#: 255, and narrow slots waste less on runs of other lengths.
_CPU_EPISODES = 128
#: Those in a slot of a GPU: an H200 needs so many for most of its speed.
_GPU_EPISODES = 65_536


def divide(group: Group, max_chunk_runs: int, num_devices: int, *, exact: bool) -> tuple[int, int]:
    """Returns ``num_chunks`` and the ``width`` of a part.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      max_chunk_runs: runs in a chunk at most.
      num_devices: among which a chunk is divided.
      exact: one run a slot.
    """
    num_chunks = -(-group.num_runs // max_chunk_runs)
    if exact:
        return num_chunks, num_devices
    # A slot is no wider than a device's share of a chunk, and has about as many episodes as are
    # played best at once. Both are rounded up.
    device_runs = -(-group.num_runs // (num_chunks * num_devices))
    slot_episodes = _CPU_EPISODES if jax.default_backend() == "cpu" else _GPU_EPISODES
    slot_runs = -(-slot_episodes // group.config.episodes_per_update)
    return num_chunks, num_devices * min(device_runs, slot_runs)


def split_runs(group: Group, name: str, num_chunks: int) -> list[Runs]:
    """Returns the runs of a group in chunks, all of one size except the last.

    Seeds come before configurations, so that every chunk has its share of each configuration and
    all take about as long.

    Args:
      group: whose configurations have ``group.config.num_seeds`` runs each.
      name: of the group, for the files.
      num_chunks: how many.
    """
    num_runs = group.num_runs
    chunk_size = -(-num_runs // num_chunks)
    # Run i has seed i // C of configuration i % C, where the group has C configurations. A race of
    # K policies takes K seeds: that of seed n those from K n on, whatever seeds are beside it.
    seed, member_index = np.divmod(np.arange(num_runs), len(group.members))
    seed += group.config.first_seed * group.config.race
    chunks = []
    for chunk_number, first_run in enumerate(range(0, num_runs, chunk_size)):
        chunk_members = member_index[first_run : first_run + chunk_size]
        chunk_seed = seed[first_run : first_run + chunk_size]
        chunks.append(
            Runs(
                f"{name}-{chunk_number:04d}",
                chunk_members,
                group.members[chunk_members],
                chunk_seed,
            )
        )
    return chunks


def _capacity(group: Group, ready_programs: Ready) -> int:
    """Returns how many runs of a group may be under way, as memory holds their states.

    Args:
      group: whose programs are traced for it, unless it is small.
      ready_programs: what they are made of.
    """
    if group.num_runs <= _MIN_CHUNK_RUNS:
        return _MIN_CHUNK_RUNS
    state_bytes = ready_programs.programs().state_bytes
    return max(1, int(_MEMORY_SHARE * host_memory() / (_NUM_COPIES * state_bytes)))


def describe(plan: Plan) -> str:
    """Returns a sentence on what a run or a sweep will do on this machine."""
    group_plans = plan.group_plans
    # Of a sweep the first configuration is named; the others may differ in what is swept.
    config = group_plans[0].group.config
    ready_programs = group_plans[0].ready
    plan_subject = f"{counted(config.num_seeds, 'seed')} of {config.env}"
    if config.race > 1:
        plan_subject += f", in races of {config.race} policies each,"
    programs = ""
    if plan.design.is_sweep:
        chunk_sizes = [len(runs.seed) for group_plan in group_plans for runs in group_plan.chunks]
        configurations = counted(plan.design.count(), "configuration")
        plan_subject = f"{configurations} of {plan_subject}, {sum(chunk_sizes):,} runs,"
        program_count = counted(len(group_plans), "compiled program")
        chunk_count = counted(len(chunk_sizes), "chunk")
        programs = f"; {program_count}, {chunk_count} of up to {max(chunk_sizes):,} runs"
    devices = _describe_devices(plan.division)
    return (
        f"Training {plan_subject} by {config.algorithm}, {_budget(config)}, on {devices}, with the "
        f"engine {ready_programs.engine}: {ready_programs.why}{programs}."
    )


def _budget(config: Config) -> str:
    """Returns for how long each seed is trained."""
    budget_units = {"minutes": "min together", "max_updates": "updates each"}
    # ``minutes`` is in place of the env steps, whose default still stands in the settings.
    if config.minutes is None:
        budget_units["env_steps"] = "env steps each"
    budgets = {unit: getattr(config, name) for name, unit in budget_units.items()}
    return " or ".join(f"{x:,} {unit}" for unit, x in budgets.items() if x is not None)


def _describe_devices(division: Division) -> str:
    """Returns which devices compute, of how many here."""
    num_devices = jax.local_device_count()
    device_kind = jax.local_devices()[0].device_kind
    if num_devices == 1:
        return counted(num_cores(), "CPU core") if device_kind == "cpu" else f"one {device_kind}"
    devices_text = f"{division.count} of the {num_devices} devices here ({device_kind})"
    if division.count > 1:
        division_unit = "seeds" if division.seeds > 1 else "episodes of an update"
        devices_text += f", which share the {division_unit}"
    return devices_text
