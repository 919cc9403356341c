"""What a run will do, how long that takes about, and how much memory it needs."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_reinforce.settings import measured, memory
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.settings.measured import Speed, Task
from mjx_reinforce.settings.memory import (
    check_fits,
    cpu_factor,
    gigabytes,
    host_memory,
    needed,
    num_cores,
    num_parameters,
)

if TYPE_CHECKING:
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.division import Division

#: The figures are good to this factor.
_ACCURACY = 2.0
#: Once it is seen how long training takes, an estimate is corrected that is wrong by more than this
#: factor, and by so many seconds.
_WRONG, _NOTICED = 3.0, 10.0
#: Networks up to this many parameters are as fast as those that were measured.
_MEASURED_PARAMETERS = 20_000
#: A small run of a task that was not measured takes so much memory, like most (bytes).
_BASE_MEMORY = 2.5e9


class Hardware(NamedTuple):
    """Where a run computes.

    name: for people
    speeds: what was measured on a machine of its kind
    faster: how many times as fast as that one it is
    memory: the memory available to arrays (bytes)
    shared: whether that is the memory that compiling needs too
    """

    name: str
    speeds: dict[str, Speed]
    faster: float
    memory: float
    shared: bool


class Plan(NamedTuple):
    """What will be done.

    text: a paragraph for people
    compiling: how long it takes to compile (s), None if that is not known
    training: how long it trains and evaluates (s), None if that is not known
    bounded: whether that is at most so long
    """

    text: str
    compiling: float | None
    training: float | None = None
    bounded: bool = False

    def correction(self, seconds: float) -> str | None:
        """Returns what is said of a training that takes so long in all (s), if the plan is wrong.

        Args:
          seconds: in all, as its first part shows; NaN if nobody knows.
        """
        if self.training is None or not is_wrong(self.training, seconds):
            return None
        if self.bounded and seconds < self.training:
            return None
        said = _training(self.training, self.bounded)
        return f"training takes about {duration(seconds)} in all, not {said} as was said"


def make_plan(ready: "Ready", config: Config) -> Plan:
    """Returns the plan of a run on this machine.

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
    speed = machine.speeds.get(config.env)
    known = num_parameters(config, task) <= _MEASURED_PARAMETERS
    if config.minutes is not None:
        time, compiling = "The first updates show how many env steps that is", None
        seconds, bounded = 60 * config.minutes, False
    elif speed is None or speed.engine != ready.engine or not known:
        time, compiling = "How long this takes here is not known", None
        seconds, bounded = None, False
    else:
        seconds, bounded = run_seconds(config, task, machine, speed)
        compiling = speed.compiling
        time = said_time(compiling, seconds, bounded)
        if not bounded and useful_part(task, speed) < 1:
            time += ", more if some seeds' episodes stay short, since all wait for the last"
    memory = gigabytes(base + needed(config, task))
    where = _where(machine, division)
    text = (
        f"Training {what} on {where}, with the engine {ready.engine}: "
        f"{ready.why}. {time}. It needs about {memory} of memory.{_idle(machine, division)}"
    )
    return Plan(text, compiling, seconds, bounded)


def is_wrong(said: float, taken: float) -> bool:
    """Returns whether an estimate (s) is so wrong that it is corrected; a NaN corrects nothing."""
    least, most = min(said, taken), max(said, taken)
    return most > _WRONG * least and most - least > _NOTICED


def run_seconds(config: Config, task: Task, machine: Hardware, speed: Speed) -> tuple[float, bool]:
    """Returns how long a run trains and evaluates on a machine (s), and whether at most so long.

    What was measured is the task with its own settings; what other networks do besides is counted.
    They learn from whole updates, in which short episodes wait for the longest.
    """
    seconds, bounded = training_seconds(config, task, speed)
    own = memory.operations_per_step(of_task(config.env, env_steps=1), task)
    beyond = max(0.0, memory.operations_per_step(config, task) - own)
    steps = config.num_seeds * _steps(config, task, task.useful)[0]
    rate = measured.CPU_OPERATIONS if machine.shared else measured.GPU_OPERATIONS
    return (seconds + steps * beyond / rate) / machine.faster, bounded


def _where(machine: Hardware, division: "Division") -> str:
    """Returns on what a run trains."""
    import jax

    here, name = jax.local_device_count(), machine.name
    if division.count > 1:
        each = f"of {name}" if machine.shared else f"({name} each)"
        what = "seeds" if division.seeds > 1 else "episodes of an update"
        name = f"{division.count} devices {each}, which share the {what}"
    elif here > 1 and not machine.shared:
        name += f", the first of the {here} here (more would not make so few episodes faster),"
    return name


def _idle(machine: Hardware, division: "Division") -> str:
    """Returns a sentence where devices stand idle and ``_where`` does not say so, else nothing."""
    if division.count == 1 and not machine.shared:
        return ""
    why = "the seeds, or the episodes of an update, are too few or do not divide evenly among more"
    return idle(division.count, why)


def idle(busy: int, why: str) -> str:
    """Returns a sentence on the devices of this process that stand idle; nothing if none does."""
    import jax

    here = jax.local_device_count()
    rest = here - busy
    return f" Of {here} devices here, {rest} stand{'s' * (rest == 1)} idle: {why}." if rest else ""


def training_seconds(config: Config, task: Task, speed: Speed) -> tuple[float, bool]:
    """Returns how long the networks that were measured take (s), and whether at most so long."""
    steps, bounded = _steps(config, task, useful_part(task, speed))
    whole = config.horizon or task.horizon
    played = config.eval_every * config.episodes_per_update * config.training_horizon(whole)
    evaluated = 2 * config.eval_episodes * whole / played
    total = config.num_seeds * steps * (1 + evaluated)
    return speed.seconds(total, config.num_seeds * config.episodes_per_update), bounded


def _steps(config: Config, task: Task, useful: float) -> tuple[float, bool]:
    """Returns the env steps that a seed simulates for training, and whether at most so many.

    It is where the number of updates ends the run: nobody knows how long their episodes are.
    """
    horizon = config.training_horizon(task.horizon)
    bounds = []
    if config.env_steps is not None:
        bounds.append((config.env_steps / useful, False))
    if config.max_updates is not None:
        updates = float(config.max_updates)
        bounds.append((updates * config.episodes_per_update * horizon, True))
    return min(bounds)


def useful_part(task: Task, speed: Speed) -> float:
    """Returns the part of the simulated env steps that counts; with ``native`` no episode waits."""
    return 1.0 if speed.engine == "native" else task.useful


def this_hardware() -> Hardware:
    """Returns where JAX computes."""
    import jax

    device = jax.local_devices()[0]
    if device.platform == "cpu":
        cores = num_cores()
        name = f"{cores} CPU core{'s' * (cores > 1)}"
        return Hardware(name, measured.CPU, cpu_factor(), host_memory(), True)
    memory = float((device.memory_stats() or {}).get("bytes_limit", float("inf")))
    return Hardware(f"one {device.device_kind}", measured.GPU, 1.0, memory, False)


def duration(seconds: float) -> str:
    """Returns a time for people, to two digits."""
    for unit, length in (("s", 1.0), ("min", 60.0), ("h", 3600.0)):
        number = seconds / length
        if number < 100 or unit == "h":
            break
    return f"{float(f'{max(number, 1):.2g}'):g} {unit}"


def said_time(compiling: float, training: float, bounded: bool) -> str:
    """Returns how long a run takes in words; the times are in s, see ``run_seconds``."""
    return (
        f"Compiling takes {_range(compiling)}, or much less if this was compiled before; "
        f"training {_training(training, bounded)}"
    )


def _training(seconds: float, bounded: bool) -> str:
    return f"at most {duration(seconds)}" if bounded else _range(seconds)


def _range(seconds: float) -> str:
    least, most = duration(seconds / _ACCURACY), duration(seconds * _ACCURACY)
    return f"about {least} to {most}" if least != most else f"about {least}"


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
    if config.env in measured.TASKS:
        known = measured.TASKS[config.env]
        return known._replace(observation=policy["observation_size"]) if config.env_set else known
    entries = 1 if "num_actions" in policy else len(policy["action_low"])
    return Task(policy["observation_size"], entries, horizon, 1.0, _BASE_MEMORY)
