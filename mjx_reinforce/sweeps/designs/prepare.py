"""From a design to all that a sweep is made of; nothing is compiled, and bad input is refused."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.devices import Devices
from mjx_reinforce.store.build import build
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.designs.grid import configure
from mjx_reinforce.sweeps.designs.groups import Group, make_groups
from mjx_reinforce.sweeps.designs.plan import chunk_limit, describe_plan, divide
from mjx_reinforce.sweeps.designs.rungs import part_trained


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


def prepare_sweep(design: Design, limits: Sequence[int] | None, num_processes: int) -> Prepared:
    """Returns what a sweep is made of.

    Args:
      design: of the sweep.
      limits: how many runs of each group a chunk may have, if the sweep goes on.
      num_processes: that train it.

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
        share = devices.count, num_processes
        limits = [
            chunk_limit(env, horizon, group, design.chunk_runs, *share)
            for env, horizon, group in zip(made, horizons, groups, strict=True)
        ]
    parts = [
        divide(group, limit, devices.count, exact=design.exact)
        for group, limit in zip(groups, limits, strict=True)
    ]
    trained = part_trained(design.search, len(configurations))
    plan = describe_plan(made, horizons, learners, groups, parts, devices.count, trained)
    engine = learners[0].engine.name, sum(learner.engine.seconds for learner in learners)
    return Prepared(made, horizons, devices, configurations, groups, list(limits), *engine, plan)
