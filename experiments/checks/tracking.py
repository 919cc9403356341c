"""How well policies of a robot on legs follow their commands, in C MuJoCo.

    python -m experiments.checks.tracking go1_run

The task is one that ``python -m mjx_reinforce.new`` wrote, in the folder at hand. Each episode has
one command, with the task's noise, delay, and pushes. A row is the mean absolute error of a seed's
last policy over all but the first seconds of 100 episodes of 10 s. From a fall on, the error is the
whole command. The last row is what a robot that stands still would have: the mean of the commands.
"""

import dataclasses
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from mjx_reinforce import load, make_vec
from mjx_reinforce.engine.checks import check_count, check_number
from mjx_reinforce.export.run_files import read_run
from mjx_reinforce.files import read_json

#: The terms of the reward that are errors, and their units.
ERRORS = {"forward_error": "m/s", "sideways_error": "m/s", "turn_error": "rad/s"}
#: More env steps than an episode has: its first command stays.
_NEVER = 10**6


@dataclasses.dataclass(frozen=True)
class TrackingSettings:
    """Measure how well the policies of a run follow their commands."""

    run: tyro.conf.Positional[Path]
    """The run directory."""
    episodes: int = 100
    """How many episodes each policy plays."""
    ignored_seconds: float = 2.0
    """The start of an episode that does not count."""
    engine: str = "mujoco"
    """What plays them."""


class Tracking(NamedTuple):
    """How well a policy follows its commands.

    errors: [3] mean absolute, in the units of ERRORS
    commands: [3] mean absolute: the errors of a robot that stands still
    standing: the share of episodes without a fall
    """

    errors: np.ndarray
    commands: np.ndarray
    standing: float


def tracking(settings: TrackingSettings, task: Any, seed: int) -> Tracking:
    """Returns how well a seed's policy follows its commands."""
    env = _with_one_command(task)()
    vec = make_vec(env, settings.episodes, engine=settings.engine, autoreset="disabled")
    weights = sys.modules[task.__module__].WEIGHTS
    policy = load(settings.run, seed)
    step = jax.jit(vec.step)
    state = jax.jit(vec.reset)(jax.random.key(7))
    commands = np.abs(state.simulation.pipeline_state.memory["command"])
    stands = np.ones(settings.episodes, bool)
    errors = []
    for _ in range(env.max_episode_steps):
        actions = policy.act(np.asarray(state.obs))
        state = step(state, jnp.asarray(actions, jnp.float32))
        terms = [np.asarray(state.metrics[f"reward_{name}"]) / weights[name] for name in ERRORS]
        stands &= ~np.asarray(state.terminated)
        errors.append(np.where(stands[:, None], np.stack(terms, axis=1), commands))
    counted = errors[round(settings.ignored_seconds / env.dt) :]
    return Tracking(
        errors=np.mean(counted, axis=(0, 1)),
        commands=np.mean(commands, axis=0),
        standing=float(stands.mean()),
    )


def _with_one_command(task: Any) -> Any:
    """Returns the class of a task, whose module now gives each episode one command."""
    module: Any = sys.modules[task.__module__]
    module.COMMAND_PERIOD = _NEVER
    module.REST_SHARE = 0.0
    return task


def main() -> None:
    """Prints a row for each seed of a run; exits 2 where there is none of such a task."""
    settings = tyro.cli(TrackingSettings, description=__doc__)
    sys.path.insert(0, "")
    try:
        task, seeds = _task_and_seeds(settings)
    except (ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print("| seed | " + " | ".join(f"{name} ({unit})" for name, unit in ERRORS.items()), end="")
    print(" | did not fall |\n|---|---|---|---|---|")
    results = {seed: tracking(settings, task, seed) for seed in seeds}
    for seed, result in results.items():
        print(_row(str(seed), result.errors, f"{result.standing:.0%}"))
    commands = np.mean([result.commands for result in results.values()], axis=0)
    print(_row("stands still", commands, ""))


def _task_and_seeds(settings: TrackingSettings) -> tuple[Any, Sequence[int]]:
    """Returns the class of a run's task, and the numbers of the run's seeds.

    Raises:
      ValueError: the run has no policy, its task follows no commands, or a setting is out of range.
      ImportError: the module of its task is not in the folder at hand.
    """
    check_count("episodes", settings.episodes)
    check_number("ignored_seconds", settings.ignored_seconds)
    run = read_run(settings.run)
    module, _, name = run.env.partition(":")
    weights = getattr(importlib.import_module(module), "WEIGHTS", {}) if name else {}
    if not ERRORS.keys() <= set(weights):
        raise ValueError(f"{settings.run} was trained on {run.env}, which follows no commands")
    seeds = run.seeds or range(read_json(settings.run / "config.json")["num_seeds"])
    return getattr(importlib.import_module(module), name), seeds


def _row(label: str, errors: np.ndarray, share: str) -> str:
    """Returns a row of the table: errors [3], and the share that did not fall."""
    cells = [label, *(f"{error:.3f}" for error in errors), share]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
