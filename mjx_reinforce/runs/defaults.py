"""The default settings of each task: what differs from those of ``settings``.

They are filled in before the command line is read, so that a flag always wins, ``--help`` shows
them, and all that comes later sees plain settings. Presets have their own.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

from mjx_reinforce import envs
from mjx_reinforce.runs.config import Config

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


def of_task(env: str) -> Config:
    """Returns the default settings for an environment, also for one that the table lacks."""
    return dataclasses.replace(Config(env=env), **_OF_TASKS.get(env, {}))


def check_task(env: str) -> None:
    """Raises ValueError for what is no id of an environment, such as a file may name."""
    envs.check_id(env)


def named_task(arguments: Sequence[str]) -> str:
    """Returns the environment that a command line names with ``--env``, or the default one."""
    named = Config().env
    for flag, following in itertools.zip_longest(arguments, arguments[1:]):
        if flag == "--env" and following:
            named = following
        elif flag.startswith("--env="):
            named = flag.removeprefix("--env=")
    return named
