"""What a run will do, and how much memory it needs."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_reinforce.engine.memory import gigabytes, host_memory
from mjx_reinforce.settings import tables
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.memory import check_fits, needed, num_cores
from mjx_reinforce.settings.tables import Task

if TYPE_CHECKING:
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.division import Division

#: A small run of a task that was not measured takes so much memory, like most (bytes).
_BASE_MEMORY = 2.5e9


class Hardware(NamedTuple):
    """Where a run computes.

    name: for people
    memory: the memory available to arrays (bytes)
    shared: whether that is the memory that compiling needs too
    """

    name: str
    memory: float
    shared: bool


def make_plan(ready: "Ready", config: Config) -> str:
    """Returns a paragraph on what a run will do on this machine.

    Args:
      ready: the run, a ``ready.Ready``.
      config: its settings.

    Raises:
      ValueError: the run does not fit into the memory that is here.
    """
    what = _what(config)
    task, machine = task_of(ready.policy, ready.horizon, config), this_hardware()
    division = ready.programs.division
    if not machine.shared:
        config = division.of_each(config, config.num_seeds)
    base = task.base_memory if machine.shared else 0.0
    check_fits(config, task, machine.memory, base)
    memory = gigabytes(base + needed(config, task))
    where = _where(machine, division)
    return (
        f"Training {what} on {where}, with the engine {ready.engine}: "
        f"{ready.why}. It needs about {memory} of memory."
    )


def _where(machine: Hardware, division: "Division") -> str:
    """Returns on what a run trains, and how many devices here are left out."""
    import jax

    here, name = jax.local_device_count(), machine.name
    if division.count > 1:
        what = "seeds" if division.seeds > 1 else "episodes of an update"
        return f"{devices_in_words(division.count, machine)}, which share the {what}"
    if here > 1 and not machine.shared:
        name += f", the first of the {here} here,"
    return name


def devices_in_words(count: int, machine: Hardware) -> str:
    """Returns how many devices compute, of how many here."""
    import jax

    here = jax.local_device_count()
    said = f"{count} devices" if count == here else f"{count} of the {here} devices here"
    return said if machine.shared else f"{said} ({machine.name} each)"


def this_hardware() -> Hardware:
    """Returns where JAX computes."""
    import jax

    device = jax.local_devices()[0]
    if device.platform == "cpu":
        cores = num_cores()
        name = f"{cores} CPU core{'s' * (cores > 1)}"
        return Hardware(name, host_memory(), True)
    memory = float((device.memory_stats() or {}).get("bytes_limit", float("inf")))
    return Hardware(f"one {device.device_kind}", memory, False)


def _what(config: Config) -> str:
    """Returns what is trained and for how long."""
    budgets, each = [], " each" if config.minutes is None else ""
    if config.minutes is not None:
        budgets.append(f"{config.minutes:g} min together")
    elif config.env_steps is not None:
        budgets.append(f"{config.env_steps:,} env steps")
    if config.max_updates is not None:
        budgets.append(f"{config.max_updates:,} updates")
    seeds = f"{config.num_seeds:,} seed{'s' * (config.num_seeds > 1)}"
    return f"{seeds} of {config.env} by {config.algorithm}, {' or '.join(budgets)}{each},"


def task_of(policy: Mapping[str, Any], horizon: int, config: Config) -> Task:
    """Returns the sizes of a task, also of the user's own.

    Args:
      policy: what ``build.policy_settings`` returns.
      horizon: the time limit of an episode in steps.
      config: the settings.
    """
    if config.env in tables.TASKS:
        known = tables.TASKS[config.env]
        return known._replace(observation=policy["observation_size"]) if config.env_set else known
    entries = 1 if "num_actions" in policy else len(policy["action_low"])
    return Task(policy["observation_size"], entries, horizon, 1.0, _BASE_MEMORY)
