"""What a run will do, and how much memory it needs, from its settings alone.

The factors were read off XLA's own account of its programs (``memory_analysis``), for 100 seeds of
toys with 4 and 300 observations and 1,000 seeds of InvertedPendulum.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_reinforce.engine.memory import gigabytes, host_memory
from mjx_reinforce.settings.config import MAX_OF_UPDATE, Config, flag, marked
from mjx_reinforce.settings.declare import Range
from mjx_reinforce.settings.defaults import may_have_accelerator, num_cores
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.settings.tables import TASKS, Task

if TYPE_CHECKING:
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.division import Division

#: A small run of a task that was not measured takes so much memory, like most (bytes).
_BASE_MEMORY = 2.5e9
_FLOAT = 4  # bytes
#: Copies of the episodes that a gradient needs: as played, scaled, and by time.
_EPISODE_COPIES = 3
#: The values of the hidden units, and what the gradient adds to them.
_ACTIVATIONS = 2
#: Parameters, gradient, two moments, and all that again while a seed's update is proposed.
_PARAMETERS = 8
#: The same of a value network: parameters, gradient, two moments.
_CRITIC_PARAMETERS = 4
#: Steps of an episode whose hidden units are held at once, see ``learning.updates``.
_CHUNK = 128
#: Bytes of an env step that an evaluation plays: the reward, the mask, and copies.
_EVALUATED = 10
#: Numbers that a seed's update reports.
_REPORTED = 20


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
    if config.env in TASKS:
        known = TASKS[config.env]
        return known._replace(observation=policy["observation_size"]) if config.env_set else known
    entries = 1 if "num_actions" in policy else len(policy["action_low"])
    return Task(policy["observation_size"], entries, horizon, _BASE_MEMORY)


def parts(config: Config, task: Task) -> dict[str, float]:
    """Returns what the arrays of a run need (bytes), under the flags that make each part smaller.

    Args:
      config: the settings.
      task: the sizes of the task; ``config`` may have another time limit.
    """
    horizon = config.training_horizon(task.horizon)
    seeds, episodes = config.num_seeds, config.episodes_per_update
    steps = seeds * horizon * episodes
    values = task.observation + task.action + 3
    evaluated = seeds * (config.horizon or task.horizon) * 2 * config.eval_episodes
    follows = Reader.GRADIENT.holds(config)  # else it tries out many policies
    fewer = "--num-episodes" if follows else "--hidden-sizes"
    held = seeds * (min(horizon, _CHUNK) if follows else 1) * episodes * sum(config.hidden_sizes)
    policies = seeds if follows else seeds * episodes
    network = _ACTIVATIONS * held + _PARAMETERS * policies * num_parameters(config, task)
    critic = config.value_hidden_sizes if Reader.VALUE_BASELINE.holds(config) else ()
    critics = _CRITIC_PARAMETERS * seeds * critic_parameters(config, task)
    valued, fitted = steps, 0
    if critic and Reader.REINFORCE.holds(config):
        fitted = seeds * config.value_batch_size
        valued = seeds * min(horizon, _CHUNK) * episodes
    fitting = fitted * (config.value_fits + values + _ACTIVATIONS * sum(critic))
    valuing = _ACTIVATIONS * valued * sum(critic) + critics
    return {
        "--value-batch-size, --value-fits or --num-seeds": _FLOAT * fitting,
        f"--num-seeds, {fewer} or --train-horizon": _FLOAT * _EPISODE_COPIES * steps * values,
        f"--hidden-sizes, --num-seeds or {fewer}": _FLOAT * network,
        "--value-hidden-sizes, --num-seeds or --train-horizon": _FLOAT * valuing,
        "--eval-episodes, --num-seeds or --horizon": _EVALUATED * evaluated,
        "--eval-every or --num-seeds": _FLOAT * _REPORTED * seeds * config.block_length,
    }


def num_parameters(config: Config, task: Task) -> int:
    """Returns how many parameters the policy has, about: mean and std have outputs of their own."""
    return _num_weights([task.observation, *config.hidden_sizes, 2 * task.action])


def critic_parameters(config: Config, task: Task) -> int:
    """Returns how many parameters the value network has, 0 where there is none."""
    if not (Reader.GRADIENT.holds(config) and Reader.VALUE_BASELINE.holds(config)):
        return 0
    return _num_weights([task.observation, *config.value_hidden_sizes, 1])


def _num_weights(widths: Sequence[int]) -> int:
    """Returns how many parameters a network has whose layers are so wide, the input first."""
    return sum((n + 1) * m for n, m in itertools.pairwise(widths))


def needed(config: Config, task: Task) -> float:
    """Returns the bytes that all arrays of a run need."""
    return math.fsum(parts(config, task).values())


def check_fits(config: Config, task: Task, available: float, base: float) -> None:
    """Raises ValueError if a run needs more memory than there is; nothing is compiled.

    Args:
      config: the settings.
      task: the sizes of the task.
      available: bytes that are there.
      base: bytes that are needed besides the arrays.
    """
    total = base + needed(config, task)
    if total <= available:
        return
    found = parts(config, task)
    raise ValueError(
        f"this run does not fit into memory: it needs about {gigabytes(total)}, "
        f"{gigabytes(available)} are here;\nlower {max(found, key=found.__getitem__)}"
    )


def check_memory(config: Config) -> None:
    """Raises ValueError for a run that cannot be, before anything heavy is imported.

    What is not known yet is taken to be small: the sizes of a task of the user's own, and the
    memory of an accelerator.
    """
    large = (*marked(Range.COUNTED), *marked(Range.SEED))
    for name, value in vars(config).items():
        numbers = value if isinstance(value, tuple) else (value,)
        counts = [x for x in numbers if isinstance(x, int)]
        if name not in large and max(counts, default=0) > MAX_OF_UPDATE:
            raise ValueError(f"{flag(name)} must be less than 2^31, got {max(counts)}")
    if not may_have_accelerator():
        task = TASKS.get(config.env, Task(1, 1, 1, 0.0))
        check_fits(config, task, host_memory(), task.base_memory)
