"""The default settings of each task: what differs from those of ``settings``.

They are filled in before the command line is read, so that a flag always wins, ``--help`` shows
them, and all that comes later sees plain settings. Presets have their own.
"""

import dataclasses
import importlib.util
import itertools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.engine.checks import whole_number
from mjx_reinforce.settings import tables
from mjx_reinforce.settings.config import CODE, Config, spoken

#: Where a budget is large, it has about so many evaluations.
_EVALUATIONS = 50
#: Of a long run, the time between two evaluations (s), with as many seeds as a default run has.
_BETWEEN = 20.0
#: A default run trains for about so long (s) with as many seeds as a default run has, and never
#: less than the task's settings in ``tuned`` say.
_DEFAULT_SECONDS = 60.0
#: CPU cores that make a run faster; it was not tried with more.
_USEFUL_CORES = 4


def of_task(
    env: str,
    env_steps: int | None = None,
    num_seeds: int = Config.num_seeds,
    seconds: float | None = None,
) -> Config:
    """Returns the default settings for an environment, also for one that the table lacks.

    Args:
      env: its id.
      env_steps: the budget of a seed; None: what a time of training gives on this machine, but no
        less than the task's settings in ``tuned`` say.
      num_seeds: that train together. More than a default run has change nothing: what a seed
        learns is then the same, and takes longer.
      seconds: that time; None: about a minute, or less where nothing more is to be had.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = mr.of_task("CartPole-v1", env_steps=20_000)
      >>> dataclasses.replace(config, num_seeds=8).num_seeds, config.env_steps
      (8, 20000)
    """
    known = tables.OF_TASKS.get(env)
    few = dataclasses.replace(Config(env=env, num_seeds=num_seeds), **(known or {}))
    if env_steps is None and seconds is None and (env in tables.SOLVED or known is None):
        return few
    rows = [(0, few)]
    for least, settings in tables.OF_BUDGETS.get(env, ()):
        rows.append((least, dataclasses.replace(few, **settings)))
    if env_steps is not None:
        chosen = next(config for least, config in reversed(rows) if env_steps >= least)
        return _with_budget(chosen, env_steps)
    given, chosen = _in_time(seconds or _DEFAULT_SECONDS, rows)
    if seconds is None:
        given = min(given, tables.ENOUGH.get(env, given))
    return _with_budget(chosen, max(given, 1 if seconds else few.env_steps or 0))


def _in_time(seconds: float, rows: Sequence[tuple[int, Config]]) -> tuple[int, Config]:
    """Returns the budget that a time gives here, and the settings for it.

    Args:
      seconds: the time.
      rows: from so many env steps on, the settings; the least first, which is 0. On a GPU the last
        hold in any case: few episodes take as long there as many.
    """
    for least, config in reversed(rows):
        together = min(config.num_seeds, Config.num_seeds)
        given = expected_env_steps(seconds, dataclasses.replace(config, num_seeds=together))
        if has_gpu() or given >= least:
            return given, config
    raise AssertionError("the first row holds for any budget")


def _with_budget(config: Config, env_steps: int) -> Config:
    """Returns settings with a budget, to which what is made for a smaller one is stretched.

    Schedules that would end before it are as long as it. Where episodes are long there are no more
    evaluations than ``_EVALUATIONS``, except in a run so long that an interrupt, which waits for
    the updates between two, would wait for more than ``_BETWEEN``.
    """
    config = dataclasses.replace(config, env_steps=env_steps)
    if isinstance(config.decay_steps, int) and config.decay_steps < env_steps:
        config = dataclasses.replace(config, decay_steps="budget")
    if config.env not in tables.TASKS:
        return config
    horizon = config.training_horizon(tables.TASKS[config.env].horizon)
    played = config.episodes_per_update * horizon
    usual = dataclasses.replace(config, num_seeds=Config.num_seeds)
    every = min(env_steps // _EVALUATIONS, expected_env_steps(_BETWEEN, usual)) // played
    return dataclasses.replace(config, eval_every=max(config.eval_every, every))


def expected_env_steps(seconds: float, config: Config) -> int:
    """Returns about how many env steps of a seed this machine trains in a time, to two digits.

    A task that was not measured has those of its default budget.
    """
    machine = tables.GPU if has_gpu() else tables.CPU
    if config.env not in machine:
        return config.env_steps or 0
    episodes = config.num_seeds * config.episodes_per_update
    each = machine[config.env].seconds(config.num_seeds, episodes)  # an env step of every seed
    steps = seconds * (1.0 if has_gpu() else cpu_factor()) / each
    return int(float(f"{steps:.2g}"))


def num_cores() -> int:
    """Returns how many CPU cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def has_gpu() -> bool:
    """Returns whether JAX is likely to find an NVIDIA GPU; JAX is not imported."""
    return may_have_accelerator() and any(Path("/dev").glob("nvidia[0-9]*"))


def cpu_factor() -> float:
    """Returns how many times as fast as two cores this machine's are together."""
    return min(num_cores(), _USEFUL_CORES) / 2


def may_have_accelerator() -> bool:
    """Returns whether JAX may find a GPU: without a plugin it has the CPU alone."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    return importlib.util.find_spec("jax_plugins") is not None


def named_code(arguments: Sequence[str]) -> dict[str, str | None]:
    """Returns what a command line says of the settings that may name code."""
    return {name: flag_value(arguments, f"--{name}") for name in CODE}


def flag_value(arguments: Sequence[str], flag: str) -> str | None:
    """Returns what a command line gives a flag, the last time that it does; None if nothing."""
    found = None
    for name, following in itertools.zip_longest(arguments, arguments[1:]):
        name, equals, value = name.partition("=")
        if spoken(name) == flag:
            found = value if equals else following or found
    return found


def for_arguments(arguments: Sequence[str]) -> Config:
    """Returns the default settings for what a command line names: the task, seeds and budget."""

    def given(flag: str, read: Callable[[str], Any]) -> Any:
        """Returns a positive number, or None, also for what the parser refuses."""
        try:
            number = read(flag_value(arguments, flag) or "")
        except ValueError:
            return None
        return number if 0 < number < float("inf") else None

    env, minutes = flag_value(arguments, "--env") or Config.env, given("--minutes", float)
    num_seeds = given("--num-seeds", whole_number) or Config.num_seeds
    seconds = None if minutes is None else 60 * minutes
    return of_task(env, given("--env-steps", whole_number), num_seeds, seconds)
