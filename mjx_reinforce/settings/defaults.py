"""The default settings of each task: what differs from those of ``settings``.

They are filled in before the command line is read, so that a flag always wins, ``--help`` shows
them, and all that comes later sees plain settings. Presets have their own.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

from mjx_reinforce import envs
from mjx_reinforce.checks import whole_number
from mjx_reinforce.settings import measured
from mjx_reinforce.settings.config import Config, spoken
from mjx_reinforce.settings.memory import cpu_factor, has_gpu

#: Found by searches, random draws at first, then 768 to 1,536 seeds of each of the best; for the
#: linear policy and for networks alike.
_PENDULUM: dict[str, Any] = {
    "hidden_sizes": (),
    "num_episodes": 4,
    "learning_rate": 0.014,
    "final_learning_rate": 1e-4,
    "decay_steps": "budget",
    "max_kl": 0.01,
    "discount": 0.995,
    "initial_std": 0.6,
    "final_std": 0.15,
    "standardize_floor": 5.5,
    "momentum": 0.5,
    "normalize_min_std": 0.12,
}

#: Environment id -> the settings that differ. Tasks with contacts are slow on CPUs: they play 8
#: or 4 episodes an evaluation, not 32. Pusher and HumanoidStandup were not searched.
#: Tests are of so many episodes that, of most policies, the variance of their mean is a quarter of
#: that over seeds or less.
_OF_TASKS: dict[str, dict[str, Any]] = {
    "InvertedPendulum-v5": _PENDULUM,
    "InvertedPendulum-v4": _PENDULUM,
    "InvertedDoublePendulum-v5": {
        "learning_rate": 4e-3,
        "max_kl": 0.0065,
        "discount": 0.994,
        "initial_std": 0.57,
        "standardize_floor": 7.0,
        "normalize_min_std": 0.3,
        "env_steps": 2_000_000,
        "decay_steps": 2_000_000,
    },
    "Reacher-v5": {
        "num_episodes": 32,
        "learning_rate": 2.6e-3,
        "max_kl": 0.01,
        "discount": 0.988,
        "initial_std": 0.54,
        "standardize_floor": 0.8,
        "env_steps": 2_000_000,
        "decay_steps": 2_000_000,
        "eval_every": 50,
        "test_episodes": 256,
    },
    "Pusher-v5": {
        "learning_rate": 5e-3,
        "max_kl": 0.01,
        "initial_std": 0.5,
        "standardize_floor": 1.0,
        "env_steps": 500_000,
        "decay_steps": 1_000_000,
        "eval_every": 25,
        "eval_episodes": 4,
        "test_episodes": 64,
    },
    "Swimmer-v5": {
        "num_episodes": 8,
        "learning_rate": 0.08,
        "max_kl": 0.004,
        "discount": 0.9993,
        "initial_std": 0.9,
        "standardize_floor": 1.75,
        "env_steps": 1_000_000,
        "decay_steps": 2_000_000,
    },
    "HalfCheetah-v5": {
        "learning_rate": 0.028,
        "max_kl": 0.006,
        "discount": 0.991,
        "initial_std": 0.44,
        "standardize_floor": 1.5,
        "env_steps": 1_000_000,
        "decay_steps": 2_000_000,
        "eval_episodes": 4,
    },
    "Hopper-v5": {
        "learning_rate": 5e-3,
        "max_kl": 0.008,
        "discount": 0.9975,
        "initial_std": 0.85,
        "standardize_floor": 2.2,
        "env_steps": 1_000_000,
        "decay_steps": 1_500_000,
        "eval_every": 10,
        "eval_episodes": 4,
    },
    "Walker2d-v5": {
        "learning_rate": 8e-3,
        "max_kl": 0.008,
        "discount": 0.998,
        "initial_std": 0.25,
        "standardize_floor": 30.0,
        "env_steps": 500_000,
        "decay_steps": 1_000_000,
        "eval_every": 10,
        "eval_episodes": 4,
    },
    "Ant-v5": {
        "learning_rate": 4e-3,
        "max_kl": 0.01,
        "initial_std": 0.2,
        "env_steps": 500_000,
        "decay_steps": 2_000_000,
        "eval_episodes": 4,
        "test_episodes": 16,
    },
    "Humanoid-v5": {
        "learning_rate": 3e-3,
        "max_kl": 0.01,
        "initial_std": 0.1,
        "env_steps": 50_000,
        "decay_steps": 1_000_000,
        "eval_every": 10,
        "eval_episodes": 4,
        "test_episodes": 16,
    },
    "HumanoidStandup-v5": {
        "learning_rate": 1e-3,
        "max_kl": 0.01,
        "initial_std": 0.3,
        "env_steps": 64_000,
        "decay_steps": 1_000_000,
        "eval_episodes": 2,
    },
}


#: What differs where many episodes make a nearly exact gradient, and long steps follow it.
_MANY_EPISODES: dict[str, Any] = {
    "num_episodes": 1024,
    "momentum": 0.5,
    "normalize_steps": None,
}
#: And where the step is that of the natural gradient,
_NATURAL: dict[str, Any] = {
    "update": "natural-gradient",
    "num_episodes": 64,
    "max_kl": 0.02,
    "discount": 0.995,
    "ended_episodes": "skip",
}
#: of few episodes or many.
_MANY_NATURAL: dict[str, Any] = _NATURAL | _MANY_EPISODES | {"max_kl": 0.05}
#: Where an update takes many seconds.
_FEW_UPDATES: dict[str, Any] = _MANY_NATURAL | {"max_kl": 0.1, "discount": 0.99, "eval_every": 2}

#: Environment id -> from so many env steps of a seed on, what else differs. The last rows, of 1,024
#: episodes, were found on one H100; those before, and Swimmer's, on two cores with 2 to 8 seeds,
#: at 4 to 20 million env steps (experiments/tuning, round 12).
_OF_BUDGETS: dict[str, tuple[tuple[int, dict[str, Any]], ...]] = {
    "Reacher-v5": ((100_000_000, _MANY_EPISODES | {"learning_rate": 0.01, "max_kl": 0.02}),),
    "Pusher-v5": (
        (2_000_000, _NATURAL | {"discount": 0.99, "initial_std": 0.9, "normalize_steps": None}),
        (100_000_000, _MANY_NATURAL | {"discount": 0.99, "initial_std": 0.9}),
    ),
    "Swimmer-v5": (
        (
            20_000_000,
            _MANY_NATURAL | {"num_episodes": 128, "max_kl": 0.01, "discount": 0.9993},
        ),
    ),
    "HalfCheetah-v5": (
        (100_000_000, {"num_episodes": 1024, "learning_rate": 0.02, "max_kl": 0.04}),
    ),
    "Hopper-v5": (
        (3_000_000, _NATURAL | {"initial_std": 0.6, "normalize_steps": None}),
        (100_000_000, _MANY_NATURAL | {"initial_std": 0.6}),
    ),
    "Walker2d-v5": (
        (5_000_000, _NATURAL | {"initial_std": 0.5, "standardize_floor": 1.0}),
        (100_000_000, _MANY_NATURAL | {"initial_std": 0.5, "standardize_floor": 1.0}),
    ),
    "Ant-v5": (
        (100_000_000, _MANY_EPISODES | {"learning_rate": 0.02, "max_kl": 0.03, "initial_std": 0.4}),
    ),
    "Humanoid-v5": ((100_000_000, _FEW_UPDATES | {"initial_std": 0.3}),),
    "HumanoidStandup-v5": ((100_000_000, _FEW_UPDATES),),
}
#: Nothing more is to be had of these in a minute than in what is said above,
_SOLVED = ("InvertedPendulum-v5", "InvertedPendulum-v4")
#: or than in so many env steps of a seed.
_ENOUGH = {
    "InvertedDoublePendulum-v5": 4_000_000,
    "Reacher-v5": 100_000_000,
    "Swimmer-v5": 40_000_000,
}

#: Where a budget is large, it has about so many evaluations.
_EVALUATIONS = 50
#: A default run trains for about so long (s) with as many seeds as a default run has, and never
#: less than the task's settings above say.
_DEFAULT_SECONDS = 60.0


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
        less than the task's settings above say.
      num_seeds: that train together. More than a default run has change nothing: what a seed
        learns is then the same, and takes longer.
      seconds: that time; None: about a minute, or less where nothing more is to be had.
    """
    few = dataclasses.replace(Config(env=env, num_seeds=num_seeds), **_OF_TASKS.get(env, {}))
    if env_steps is None and seconds is None and (env in _SOLVED or env not in _OF_TASKS):
        return few
    rows = [(0, few)]
    for least, settings in _OF_BUDGETS.get(env, ()):
        rows.append((least, dataclasses.replace(few, **settings)))
    if env_steps is not None:
        chosen = next(config for least, config in reversed(rows) if env_steps >= least)
        return _with_budget(chosen, env_steps)
    given, chosen = _in_time(seconds or _DEFAULT_SECONDS, rows)
    if seconds is None:
        given = min(given, _ENOUGH.get(env, given))
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

    Schedules that would end before it are as long as it, and where episodes are long there are no
    more than ``_EVALUATIONS``.
    """
    config = dataclasses.replace(config, env_steps=env_steps)
    if isinstance(config.decay_steps, int) and config.decay_steps < env_steps:
        config = dataclasses.replace(config, decay_steps="budget")
    if config.env not in measured.TASKS:
        return config
    played = config.episodes_per_update * measured.TASKS[config.env].horizon
    every = env_steps // played // _EVALUATIONS
    return dataclasses.replace(config, eval_every=max(config.eval_every, every))


def expected_env_steps(seconds: float, config: Config) -> int:
    """Returns about how many env steps of a seed this machine trains in a time, to two digits.

    A task that was not measured has those of its default budget.
    """
    machine = measured.GPU if has_gpu() else measured.CPU
    if config.env not in machine:
        return config.env_steps or 0
    speed, task = machine[config.env], measured.TASKS[config.env]
    useful = 1.0 if speed.engine == "native" else task.useful
    episodes = config.num_seeds * config.episodes_per_update
    each = speed.seconds(config.num_seeds, episodes)  # an env step of every seed
    steps = useful * seconds * (1.0 if has_gpu() else cpu_factor()) / each
    return int(float(f"{steps:.2g}"))


def check_task(env: str) -> None:
    """Raises ValueError for what is no id of an environment, such as a file may name."""
    envs.check_id(env)


def named_task(arguments: Sequence[str]) -> str:
    """Returns the environment that a command line names with ``--env``, or the default one."""
    return flag_value(arguments, "--env") or Config().env


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
    env_steps, num_seeds = (
        _positive_number(flag_value(arguments, f)) for f in ("--env-steps", "--num-seeds")
    )
    minutes = flag_value(arguments, "--minutes") or ""
    try:
        seconds = 60 * float(minutes)
    except ValueError:  # none, or what the parser refuses
        seconds = None
    known = seconds if seconds and 0 < seconds < float("inf") else None
    return of_task(named_task(arguments), env_steps, num_seeds or Config.num_seeds, known)


def _positive_number(text: str | None) -> int | None:
    """Returns a number from a command line; None for none, and for what the parser refuses."""
    try:
        number = whole_number(text or "")
    except ValueError:
        return None
    return number if number > 0 else None
