"""Others' PPO programs on our environments and on Gymnasium's: return and seconds of both.

    pip install -e ".[dev]" stable-baselines3 tensorboard
    python -m experiments.speed.trainers stable-baselines3 --num-envs 64
    python -m experiments.speed.trainers clean-rl --program ppo_continuous_action.py
    python -m experiments.speed.trainers brax
    python -m experiments.speed.trainers rejax
    python -m experiments.speed.trainers table

trains each seed on Gymnasium's environments and then on ours, so that a busy machine slows both,
and adds a row for each to docs/trainers.csv; brax and rejax, which train on environments in JAX,
train on our task under their own wrappers in its place. ``table`` prints the table of
docs/vector.md. CleanRL's program is the user's to download (``cleanrl_ppo.py``); rejax is
``pip install rejax gymnax==0.0.9``.
"""

import dataclasses
import functools
import importlib.metadata
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.kit import rows as kit
from experiments.kit.places import DOCS

ROWS = DOCS / "trainers.csv"
COLUMNS: tuple[str, ...] = (
    *("date", "commit", "machine", "program", "libraries", "task", "environment", "num_envs"),
    *("seed", "env_steps", "mean_return", "start_seconds", "seconds", "cpu_seconds", "settings"),
)
#: Whose environments, in the rows of ours.
OURS = "mjx_reinforce"
_NUMBERS = ("env_steps", "mean_return", "start_seconds", "seconds", "cpu_seconds")


@dataclasses.dataclass(frozen=True)
class _Run:
    """What every program is told."""

    num_envs: int = 8
    """Environments that play at once, on either side."""
    rollout: int = 2048
    """Env steps between updates, of all environments together."""
    env_steps: int = 100_000
    """Of a training; the program ends with the rollout that reaches it."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Trainings on each side."""
    rows: Path = ROWS
    """The file that gets the rows."""


@dataclasses.dataclass(frozen=True)
class Sb3(_Run):
    """Stable-Baselines3's PPO with its default settings, and normalised as in its zoo."""

    task: str = "Hopper-v5"
    """An id of Gymnasium's MuJoCo tasks."""


@dataclasses.dataclass(frozen=True)
class CleanRl(_Run):
    """CleanRL's PPO with its own settings, of which one statement is changed."""

    program: Path = Path("ppo_continuous_action.py")
    """CleanRL's cleanrl/ppo_continuous_action.py, as downloaded."""
    task: str = "HalfCheetah-v5"
    """An id of Gymnasium's MuJoCo tasks."""


@dataclasses.dataclass(frozen=True)
class Brax(_Run):
    """brax's PPO with its settings for the task, under brax's own wrappers and on ours."""

    task: str = "HalfCheetah-v5"
    """An id of ours for which brax has settings."""
    num_envs: int = 256
    """Environments that play at once, on either side."""
    rollout: int = 10_240
    """Env steps between updates, of all environments together."""


@dataclasses.dataclass(frozen=True)
class Rejax(_Run):
    """rejax's PPO with its settings for the task, under its own wrapper of brax's and on ours."""

    task: str = "HalfCheetah-v5"
    """A key of ``rejax_ppo.SETTINGS``."""
    num_envs: int = 32
    """Environments that play at once, on either side."""
    rollout: int = 1024
    """Env steps between updates, of all environments together."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Print the table of docs/vector.md."""

    rows: Path = ROWS
    """The file that has the rows."""


_Command = (
    Annotated[Sb3, tyro.conf.subcommand("stable-baselines3")]
    | Annotated[CleanRl, tyro.conf.subcommand("clean-rl")]
    | Annotated[Brax, tyro.conf.subcommand("brax")]
    | Annotated[Rejax, tyro.conf.subcommand("rejax")]
    | Annotated[Table, tyro.conf.subcommand("table")]
)


def main(command: _Command) -> None:
    """Does what the command line says."""
    if isinstance(command, Table):
        print(table(read(command.rows)))
    elif isinstance(command, Sb3):
        from experiments.speed.trainers import sb3_ppo

        compare("Stable-Baselines3", ("stable_baselines3", "torch"), sb3_ppo.train, command)
    elif isinstance(command, Brax):
        from experiments.speed.trainers import brax_ppo

        compare("brax", ("brax",), brax_ppo.train, command, ("brax", OURS))
    elif isinstance(command, Rejax):
        from experiments.speed.trainers import rejax_ppo

        compare("rejax", ("rejax", "brax"), rejax_ppo.train, command, ("rejax", OURS))
    else:
        from experiments.speed.trainers import cleanrl_ppo

        program = command.program.resolve(strict=True)
        train = functools.partial(cleanrl_ppo.train, program=program)
        compare("CleanRL", ("torch",), train, command)


def compare(
    program: str,
    libraries: tuple[str, ...],
    train: Callable[..., Any],
    told: Sb3 | CleanRl | Brax | Rejax,
    sides: tuple[str, str] = ("gymnasium", OURS),
) -> None:
    """Trains each seed on both sides, and adds their rows."""
    from mjx_reinforce.console.jax_setup import configure_jax

    configure_jax()

    versions = {name: importlib.metadata.version(name) for name in (*libraries, "gymnasium", "jax")}
    known = {"date": kit.now(), "commit": kit.commit(), "machine": kit.machine()}
    known |= {"program": program, "libraries": kit.words(versions)}
    for seed in told.seeds:
        for side in sides:
            found = train(
                side, told.task, told.num_envs, seed, told.env_steps, rollout=told.rollout
            )
            row = known | {
                "task": told.task,
                "environment": side,
                "num_envs": told.num_envs,
                "seed": seed,
                "env_steps": found.env_steps,
                "mean_return": f"{found.mean_return:.2f}",
                "start_seconds": f"{found.start_seconds:.2f}",
                "seconds": f"{found.seconds:.2f}",
                "cpu_seconds": f"{found.cpu_seconds:.2f}",
                "settings": found.settings,
            }
            kit.append(told.rows, [row], COLUMNS)
            print(
                f"{program} {told.task} on {side}, seed {seed}: return {row['mean_return']} after "
                f"{found.env_steps:,} env steps and {row['seconds']} s",
                flush=True,
            )


def read(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of a file, numbers as numbers."""
    return [row | {name: float(row[name]) for name in _NUMBERS} for row in kit.read(path)]


def table(rows: list[dict[str, Any]]) -> str:
    """Returns a line for each program, task and number of environments, as Markdown.

    The return is the mean over seeds, and the least to the greatest. Seconds are medians over
    seeds: by the clock, and of computing on any core.
    """
    lines = [
        "| program | task | environments | env steps | seeds | return on theirs | return on ours "
        "| seconds (CPU) on theirs | seconds (CPU) on ours |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    cases = dict.fromkeys((row["program"], row["task"], row["num_envs"]) for row in rows)
    for case in cases:
        some = [row for row in rows if (row["program"], row["task"], row["num_envs"]) == case]
        sides = [[row for row in some if (row["environment"] == OURS) == ours] for ours in (0, 1)]
        if not all(sides):  # the second is still being trained
            continue
        played, seeds = f"{some[0]['env_steps']:,.0f}", str(len(sides[1]))
        cells = [*case, played, seeds, *map(_return, sides), *map(_time, sides)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _return(rows: list[dict[str, Any]]) -> str:
    values = [row["mean_return"] for row in rows]
    return f"{np.mean(values):,.0f} ({min(values):,.0f} to {max(values):,.0f})"


def _time(rows: list[dict[str, Any]]) -> str:
    wall, cpu = (np.median([row[name] for row in rows]) for name in ("seconds", "cpu_seconds"))
    return f"{wall:,.0f} ({cpu:,.0f})"


if __name__ == "__main__":
    main(tyro.cli(_Command, prog="python -m experiments.speed.trainers", description=__doc__))
