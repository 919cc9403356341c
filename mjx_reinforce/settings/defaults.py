"""The default settings of each task: what differs from those of ``groups``.

They are filled in before the command line is read, so that a flag always wins, ``--help`` shows
them, and all that comes later sees plain settings. ``tuned.toml`` has what searches found, by task
and budget, and ``presets.toml`` published programs under names; each explains its words.
"""

import dataclasses
import functools
import importlib.util
import itertools
import operator
import os
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.engine.checks import whole_number
from mjx_reinforce.engine.memory import num_cores  # noqa: F401 (its users find it here)
from mjx_reinforce.settings.config import CODE, MAX_COUNT, Config, spoken


def read_tables(name: str) -> dict[str, dict[str, Any]]:
    """Returns the tables of settings in a TOML file of this folder, in which "None" is None.

    A table has the settings of those that it is ``like``, which stand before it, and its own.
    """
    text = Path(__file__).with_name(name).read_text("utf-8")
    tables: dict[str, dict[str, Any]] = {}
    for title, table in tomllib.loads(text).items():
        parents = [tables[parent] for parent in table.pop("like", ())]
        # TOML has neither tuples nor None.
        settings = {name: tuple(x) if isinstance(x, list) else x for name, x in table.items()}
        settings = {name: None if x == "None" else x for name, x in settings.items()}
        # Of two the later one counts, and the table's own values count most.
        tables[title] = functools.reduce(operator.or_, [*parents, settings])
    return tables


#: name -> (a line for --help, the settings).
PRESETS: dict[str, tuple[str, Config]] = {
    name: (table.pop("about"), Config(**table))
    for name, table in read_tables("presets.toml").items()
    if "about" in table
}

#: What a table says beside settings.
_NO_SETTINGS = ("task", "at_least", "minute")
_TUNED = read_tables("tuned.toml")
#: Environment id -> its time limit (env steps).
HORIZONS: dict[str, int] = _TUNED.pop("horizons")
#: Name of a task of Playground's suite -> entries of an action, and the time of an env step (s).
SUITE: dict[str, tuple[int, float]] = _TUNED.pop("playground")
_ROWS = [table for table in _TUNED.values() if "task" in table]


def _without_facts(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in _NO_SETTINGS}


_SMALLEST = {row["task"]: row for row in _ROWS if "at_least" not in row}
#: Environment id -> the settings that differ from those of ``groups``.
OF_TASKS: dict[str, dict[str, Any]] = {task: _without_facts(row) for task, row in _SMALLEST.items()}
#: Environment id -> from so many env steps of a seed on, what else differs.
OF_BUDGETS: dict[str, list[tuple[int, dict[str, Any]]]] = {}
for _row in _ROWS:
    if "at_least" in _row:
        OF_BUDGETS.setdefault(_row["task"], []).append((_row["at_least"], _without_facts(_row)))
#: Environment id -> about how many env steps of a seed a minute trains, on a CPU and on a GPU.
MINUTES: dict[str, tuple[int, int]] = {
    task: row["minute"] for task, row in _SMALLEST.items() if "minute" in row
}

#: What stands before the names of Playground's tasks.
_PLAYGROUND = "playground:"
#: An action is credited with the rewards of about so long (s).
_CREDIT_SECONDS = 2.0
#: The limit of an update, for each entry of an action (nats). That of several entries is the sum
#: of theirs; of Gymnasium's tasks, those found for many episodes are 0.005 to 0.019 an entry.
_ENTRY_KL = 0.025
#: Training episodes are cut after so long at first (s).
_CUT_SECONDS = 10.0
for _name, (_num_entries, _seconds) in SUITE.items():
    _figures = {
        "discount": 1 - _seconds / _CREDIT_SECONDS,
        "max_kl": _ENTRY_KL * _num_entries,
        "train_horizon": round(_CUT_SECONDS / _seconds),
    }
    OF_TASKS[_PLAYGROUND + _name] = _TUNED["suite"] | _figures
    _long = _TUNED["suite-long"]
    OF_BUDGETS[_PLAYGROUND + _name] = [(_long["at_least"], _without_facts(_long))]

#: Where a budget is large, it has about so many evaluations.
_EVALUATIONS = 50
#: More env steps of a seed than a minute gives the small tasks, whose default run is shorter.
_PLENTY = 60_000_000
#: In a long run it has so many a minute, of as many seeds as a default run has.
_PER_MINUTE = 3


def of_task(
    env: str,
    env_steps: int | None = None,
    num_seeds: int = Config.num_seeds,
    minutes: float | None = None,
) -> Config:
    """Returns the default settings for an environment, also for one that the table lacks.

    Settings for a smaller budget are stretched: a schedule that would end before the run is as long
    as the run, and with long episodes there are at most some fifty evaluations.

    Args:
      env: its id.
      env_steps: the budget of a seed; None: what about a minute of training gives.
      num_seeds: that train together. More than a default run has change nothing: what a seed
        learns is then the same, and takes longer.
      minutes: what the settings are for in place of a budget.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = mr.of_task("CartPole-v1", env_steps=20_000)
      >>> dataclasses.replace(config, num_seeds=8).num_seeds, config.env_steps
      (8, 20000)
    """
    base = dataclasses.replace(Config(env=env, num_seeds=num_seeds), **OF_TASKS.get(env, {}))
    config = base
    speeds = MINUTES.get(env)
    if env_steps is None and minutes is None and not speeds:
        return base
    # Env steps of a seed in a minute. Of small tasks none are measured, for their default run is
    # shorter; of a task of the user's own nobody knows, and the default budget stands for them.
    if speeds:
        cpu_speed, gpu_speed = speeds
        # Two cores share their time among the seeds, so fewer seeds get more of it each, up to the
        # greater of both numbers: more is of no use to the task.
        shared = cpu_speed * Config.num_seeds // min(max(num_seeds, 1), Config.num_seeds)
        minute_steps = gpu_speed if has_gpu() else min(shared, max(speeds))
    elif env in HORIZONS:
        minute_steps = _PLENTY
    else:
        minute_steps = base.env_steps or 0
    budget = env_steps
    if budget is None:
        steps = round(minute_steps * (1 if minutes is None else minutes))
        budget = min(max(1, steps), MAX_COUNT)
    for min_steps, settings in OF_BUDGETS.get(env, ()):
        # On a GPU few episodes take as long as many.
        if budget >= min_steps or (env_steps is None and has_gpu()):
            config = dataclasses.replace(base, **settings)
    config = dataclasses.replace(config, env_steps=budget)
    # After its decay a run would go on at the final learning rate, which is the lowest.
    if isinstance(config.decay_steps, int) and config.decay_steps < budget:
        config = dataclasses.replace(config, decay_steps="budget")
    if env not in HORIZONS:
        return config
    # In a run so long that an interrupt, which waits for the updates between two evaluations, would
    # wait long, there are a few a minute.
    period = min(budget // _EVALUATIONS, minute_steps // _PER_MINUTE)
    period //= config.episodes_per_update * config.training_horizon(HORIZONS[env])
    return dataclasses.replace(config, eval_every=max(config.eval_every, period))


def has_gpu() -> bool:
    """Returns whether JAX is likely to find an NVIDIA GPU; JAX is not imported.

    Without a plugin it has the CPU alone.
    """
    if os.environ.get("JAX_PLATFORMS") == "cpu" or not importlib.util.find_spec("jax_plugins"):
        return False
    return any(Path("/dev").glob("nvidia[0-9]*"))


def named_code(arguments: Sequence[str]) -> dict[str, str | None]:
    """Returns what a command line says of the settings that may name code."""
    return {name: flag_value(arguments, f"--{name}") for name in CODE}


def flag_value(arguments: Sequence[str], flag: str) -> str | None:
    """Returns what a command line gives a flag, the last time that it does; None if nothing."""
    flag_text = None
    for word, next_word in itertools.zip_longest(arguments, arguments[1:]):
        name, equals, text = word.partition("=")
        # Both spellings are accepted, --env-steps and --env_steps.
        if spoken(name) != flag:
            continue
        if equals:
            flag_text = text
        elif next_word:
            flag_text = next_word
    return flag_text


#: The flags of which any says when a run ends.
_BUDGET_FLAGS = ("--env-steps", "--minutes", "--max-updates")


def for_arguments(arguments: Sequence[str], *, timed: bool = False) -> Config:
    """Returns the default settings for what a command line names: the task, seeds and budget.

    Args:
      arguments: of the command line.
      timed: whether a task of which ``MINUTES`` knows is trained for a minute, if nothing else
        is said; else for as many env steps as that is about.
    """

    def positive_number(flag: str, read: Callable[[str], Any]) -> Any:
        """Returns a positive number, or None, also for what the parser refuses."""
        try:
            number = read(flag_value(arguments, flag) or "")
        except ValueError:
            return None
        return number if 0 < number < float("inf") else None

    config = of_task(
        flag_value(arguments, "--env") or Config.env,
        env_steps=positive_number("--env-steps", whole_number),
        num_seeds=positive_number("--num-seeds", whole_number) or Config.num_seeds,
        minutes=positive_number("--minutes", float),
    )
    if timed and config.env in MINUTES and not any(flag_value(arguments, x) for x in _BUDGET_FLAGS):
        return dataclasses.replace(config, minutes=1.0)
    return config
