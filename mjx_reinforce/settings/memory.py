"""What a run needs, from its settings alone: memory, and whether that is there.

The factors were read off XLA's own account of its programs (``memory_analysis``), for 100 seeds of
toys with 4 and 300 observations and 1,000 seeds of InvertedPendulum.
"""

import importlib.util
import itertools
import math
import os
from collections.abc import Sequence
from pathlib import Path

from mjx_reinforce.engine.memory import gigabytes, host_memory
from mjx_reinforce.registry import PROGRAMS, SEARCHES
from mjx_reinforce.settings.config import MAX_OF_UPDATE, Config, flag, marked
from mjx_reinforce.settings.declare import Range
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.settings.tables import TASKS, Task

_FLOAT = 4  # bytes
#: Copies of the episodes that a gradient needs: as played, scaled, and by time.
_EPISODE_COPIES = 3
#: The values of the hidden units, and what the gradient adds to them.
_ACTIVATIONS = 2
#: Parameters, gradient, two moments, and all that again while a seed's update is proposed.
_PARAMETERS = 8
#: The same of a value network: parameters, gradient, two moments.
_CRITIC_PARAMETERS = 4
#: Steps of an episode whose hidden units are held at once, see ``learners.gradients``.
_CHUNK = 128
#: Bytes of an env step that an evaluation plays: the reward, the mask, and copies.
_EVALUATED = 10
#: Numbers that a seed's update reports.
_REPORTED = 20


#: CPU cores that make a run faster; it was not tried with more.
_USEFUL_CORES = 4


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
    follows = config.algorithm not in SEARCHES  # a gradient; else it searches with many policies
    fewer = "--num-episodes" if follows else "--hidden-sizes"
    held = seeds * (min(horizon, _CHUNK) if follows else 1) * episodes * sum(config.hidden_sizes)
    policies = seeds if follows else seeds * episodes
    network = _ACTIVATIONS * held + _PARAMETERS * policies * num_parameters(config, task)
    critic = config.value_hidden_sizes if Reader.VALUE_BASELINE.holds(config) else ()
    critics = _CRITIC_PARAMETERS * seeds * critic_parameters(config, task)
    valued, fitted = steps, 0
    if critic and config.algorithm not in PROGRAMS:
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
    if config.algorithm in SEARCHES or not Reader.VALUE_BASELINE.holds(config):
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
    if not _may_have_accelerator():
        task = TASKS.get(config.env, Task(1, 1, 1, 1.0, 0.0))
        check_fits(config, task, host_memory(), task.base_memory)


def num_cores() -> int:
    """Returns how many CPU cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def has_gpu() -> bool:
    """Returns whether JAX is likely to find an NVIDIA GPU; JAX is not imported."""
    return _may_have_accelerator() and any(Path("/dev").glob("nvidia[0-9]*"))


def cpu_factor() -> float:
    """Returns how many times as fast as two cores this machine's are together."""
    return min(num_cores(), _USEFUL_CORES) / 2


def _may_have_accelerator() -> bool:
    """Returns whether JAX may find a GPU: without a plugin it has the CPU alone."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    return importlib.util.find_spec("jax_plugins") is not None
