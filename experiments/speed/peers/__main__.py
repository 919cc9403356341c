"""What others reach in the same seconds: Stable-Baselines3's PPO and SAC, and brax's PPO.

``python -m experiments.speed.peers sb3 --tasks Hopper-v5 --seconds 60,600 --cores 2`` trains
Stable-Baselines3 (``pip install stable-baselines3 "gymnasium[mujoco]"``) on Gymnasium's tasks;
``python -m experiments.speed.peers brax --tasks Hopper-v5 --seconds 60,600`` brax's PPO on our
environments, on the GPU if there is one. Each adds a row to docs/peers.csv for each task, seed
and budget, as soon as that was reached. Evaluations, of policies without noise, do not count as
training. Of several at once, each needs a file of its own (``--rows``).
"""

import argparse
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.kit import rows as kit
from experiments.kit.places import DOCS
from experiments.speed.peers import rows
from experiments.speed.peers.settings import ALGORITHMS, TASKS


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.speed.peers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    sb3 = commands.add_parser("sb3", help="Stable-Baselines3 on Gymnasium's tasks")
    sb3.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    sb3.add_argument("--cores", type=int, default=2, help="that it may use")
    brax = commands.add_parser("brax", help="brax's PPO on our environments")
    for command, episodes in ((sb3, 20), (brax, 128)):
        command.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
        command.add_argument("--seeds", nargs="+", type=int, default=[0])
        command.add_argument("--seconds", default="60,600", help="of training; several budgets")
        command.add_argument("--episodes", type=int, default=episodes, help="of an evaluation")
        command.add_argument("--rows", type=Path, default=DOCS / "peers.csv")
    arguments = parser.parse_args()
    try:
        run(arguments)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def run(arguments: argparse.Namespace) -> None:
    """Trains every peer, one after the other.

    Raises:
      ValueError: an argument is out of its range, or a package is missing.
    """
    seconds = rows.budgets(arguments.seconds)
    if arguments.episodes < 1:
        raise ValueError(f"--episodes is {arguments.episodes}; give at least 1")
    peers = _sb3(arguments) if arguments.command == "sb3" else _brax()
    shared = {"date": kit.now(), "commit": kit.commit(), "machine": kit.machine()}
    for task in arguments.tasks:
        for seed in arguments.seeds:
            for peer, (facts, train) in peers.items():
                row = {**shared, **facts, "peer": peer, "task": task, "seed": seed}
                train(task, seed, seconds, arguments.episodes, _reporter(arguments.rows, row))


def _reporter(path: Path, known: dict[str, Any]) -> Callable[[dict[str, Any]], None]:
    def report(found: dict[str, Any]) -> None:
        row = known | found
        kit.append(path, [row], rows.COLUMNS)
        print(
            f"{row['peer']} {row['task']} seed {row['seed']}: {row['mean_return']} after "
            f"{row['seconds']} s, {row['env_steps']:,} env steps",
            flush=True,
        )

    return report


def _sb3(arguments: argparse.Namespace) -> dict[str, tuple[dict[str, Any], Callable[..., None]]]:
    for name in ("stable_baselines3", "torch", "gymnasium"):
        if importlib.util.find_spec(name) is None:
            raise ValueError(
                f"{name} is not installed; pip install stable-baselines3 'gymnasium[mujoco]'"
            )
    import functools

    from experiments.speed.peers import sb3 as peers_sb3

    peers_sb3.pin(arguments.cores)
    facts = peers_sb3.facts()
    return {
        f"Stable-Baselines3 {name}": (facts, functools.partial(peers_sb3.train, name))
        for name in arguments.algorithms
    }


def _brax() -> dict[str, tuple[dict[str, Any], Callable[..., None]]]:
    from mjx_reinforce.console.jax_setup import configure_jax

    configure_jax()
    from experiments.speed.peers import brax as peers_brax

    return {"brax PPO": (peers_brax.facts(), peers_brax.train)}


if __name__ == "__main__":
    main()
