"""Does a number of episodes that follows the noise win by the clock against fixed ones?

    python -m experiments.studies.auto_episodes run --output DIR [--task ID ...] [--arm ARM ...]
    python -m experiments.studies.auto_episodes table DIR

An arm is a number of episodes an update, or auto:R, which plays R episodes for each of the noise
scale B. Every arm trains the same seeds, side by side, for the same seconds, which the learning
rate's decay goes by; evaluations are not in them. DIR/TASK.csv has a row for each evaluation and
seed. The table says when an arm's mean return had made nine tenths of the way from the first
evaluation to the best that any fixed number ended with.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.kit.rows import read
from mjx_reinforce import envs
from mjx_reinforce.files import csv_bytes, write_bytes
from mjx_reinforce.learners import reinforce as builder
from mjx_reinforce.learners.pace import AutoEpisodes
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.store.build import build
from mjx_reinforce.training.evaluation import evaluate

ARMS = ("auto:1", "16", "64", "256", "1024")
#: Task -> what suits larger batches, found by hand, where it differs from the task's defaults.
TASKS: dict[str, dict[str, Any]] = {
    "InvertedDoublePendulum-v5": {},
    "Hopper-v5": {
        "learning_rate": 0.02,
        "max_kl": 0.03,
        "discount": 0.995,
        "initial_std": 0.6,
        "normalize_steps": None,
    },
    "HalfCheetah-v5": {"learning_rate": 0.01, "max_kl": 0.02},
}
COLUMNS = ("arm", "seed", "seconds", "updates", "env_steps", "episodes", "eval_return")
#: Evaluations of an arm, and episodes of each.
_LOOKS, _EPISODES = 40, 8
_PART = 0.9


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="train")
    run.add_argument("--output", type=Path, required=True)
    run.add_argument("--task", nargs="+", default=list(TASKS), choices=TASKS)
    run.add_argument("--arm", nargs="+", default=ARMS)
    run.add_argument("--seconds", type=float, default=60.0, help="of training, for each arm")
    run.add_argument("--num-seeds", type=int, default=4)
    run.add_argument("--seed", type=int, default=900, help="root of the seeds' keys")
    commands.add_parser("table", help="summarise").add_argument("directory", type=Path)
    given = parser.parse_args()
    if given.command == "table":
        print(table(given.directory))
        return
    given.output.mkdir(parents=True, exist_ok=True)
    for task in given.task:
        rows: list[dict[str, Any]] = []
        for arm in given.arm:
            rows += train(task, arm, given.seconds, given.num_seeds, given.seed)
            write_bytes(given.output / f"{task}.csv", csv_bytes(COLUMNS, rows))
    print(table(given.output))


def make(env: Any, config: Config, arm: str) -> tuple[Any, int]:
    """Returns the learner of an arm, and the time limit of its episodes."""
    kind, _, number = arm.partition(":")
    if kind != "auto":
        return build(env, dataclasses.replace(config, num_episodes=int(arm)))
    auto = AutoEpisodes(ratio=float(number or 1))
    plain = builder.reinforce
    builder.reinforce = lambda env, **given: plain(env, **{**given, "num_episodes": auto})
    try:
        return build(env, config)
    finally:
        builder.reinforce = plain


def train(
    task: str, arm: str, seconds: float, num_seeds: int, seed: int
) -> Iterator[dict[str, Any]]:
    """Yields the rows of an arm."""
    env = envs.make(task)
    config = dataclasses.replace(
        of_task(task), **TASKS[task], decay_steps="budget", num_seeds=num_seeds
    )
    learner, horizon = make(env, config, arm)
    look = functools.partial(
        evaluate, env, learner, num_episodes=_EPISODES, horizon=horizon, sampled=False
    )
    roots = jax.random.split(jax.random.key(seed), 2)
    keys, eval_keys = (jax.random.split(key, num_seeds) for key in roots)
    states = jax.jit(jax.vmap(learner.init))(keys)
    step = jax.jit(jax.vmap(learner.step)).lower(states).compile()
    looking = jax.jit(jax.vmap(look)).lower(states.actor, eval_keys).compile()
    jax.block_until_ready((step(states), looking(states.actor, eval_keys)))
    used, updates = 0.0, 0
    env_steps, episodes = np.zeros((2, num_seeds), np.int64)
    for share in np.linspace(0, 1, _LOOKS + 1):
        while used < share * seconds:
            began = time.perf_counter()
            progress = jnp.full(num_seeds, min(used / seconds, 1.0))
            states, metrics = step(dataclasses.replace(states, progress=progress))
            jax.block_until_ready(states)
            used, updates = used + time.perf_counter() - began, updates + 1
            env_steps += np.asarray(metrics["env_steps"])
            episodes += np.asarray(metrics["episodes"])
        returns = np.asarray(looking(states.actor, eval_keys)["eval_return"])
        print(
            f"{task} {arm}: {used:6.1f} s, {updates:,} updates, {returns.mean():,.1f}", flush=True
        )
        for s in range(num_seeds):
            counts = (updates, int(env_steps[s]), int(episodes[s]))
            values = (arm, s, round(used, 3), *counts, float(returns[s]))
            yield dict(zip(COLUMNS, values, strict=True))


def table(directory: Path) -> str:
    """Returns what the files of a directory say, as Markdown."""
    lines = [
        f"| task | arm | last return (worst seed) | seconds to {_PART:.0%} | of the best fixed | "
        "updates | episodes an update |",
        "|---|---|---|---|---|---|---|",
    ]
    for path in sorted(directory.glob("*.csv")):
        rows = read(path)
        arms = {row["arm"]: _curve([x for x in rows if x["arm"] == row["arm"]]) for row in rows}
        fixed = [arm for arm in arms if arm.isdigit()]
        first = np.mean([arms[arm]["eval_return"][0].mean() for arm in arms])
        best = max(arms[arm]["eval_return"][-1].mean() for arm in fixed or arms)
        target = first + _PART * (best - first)
        took = {arm: _reached(curve, target) for arm, curve in arms.items()}
        least = min((took[arm] for arm in fixed), default=np.nan)
        for arm, curve in arms.items():
            last, updates = curve["eval_return"][-1], curve["updates"][-1, 0]
            lines.append(
                f"| {path.stem} | {arm} | {last.mean():,.0f} ({last.min():,.0f}) | "
                f"{_number(took[arm])} | {_number(took[arm] / least)} | {updates:,.0f} | "
                f"{curve['episodes'][-1].mean() / updates:,.0f} |"
            )
    return "\n".join(lines)


def _curve(rows: list[dict[str, str]]) -> dict[str, np.ndarray]:
    """Returns each column [evaluations, seeds] of an arm."""
    seeds = len({row["seed"] for row in rows})
    names = [name for name in COLUMNS if name != "arm"]
    return {x: np.array([float(row[x]) for row in rows]).reshape(-1, seeds) for x in names}


def _reached(curve: dict[str, np.ndarray], target: float) -> float:
    """Returns when (s) the mean return over seeds was first at the target; inf if never."""
    there = curve["eval_return"].mean(axis=1) >= target
    return float(curve["seconds"][np.argmax(there), 0]) if there.any() else np.inf


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "never"


if __name__ == "__main__":
    main()
