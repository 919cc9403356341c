"""Do the presets learn as the programs they are named after? Their curves and ours, and a test.

    python -m experiments.studies.reproduce                       # the tables of docs/documents.md
    python -m experiments.studies.reproduce --preset categorical-cartpole --seeds 16

The programs' own curves, a few seeds each, are in reference.json. Ours come from many seeds that
train together. Where a program has a mistake that can be taken out, so do as many without it.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
import tyro

from experiments.kit.markdown import table
from experiments.studies.reproduce.cases import CASES, Case, limit, load_reference
from experiments.studies.reproduce.mistakes import STALE, stale_starts
from experiments.studies.reproduce.statistics import LEVEL, compare, compare_repair
from mjx_reinforce import envs
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import PRESETS
from mjx_reinforce.setup.build import build, policy_settings
from mjx_reinforce.training.programs import programs_of
from mjx_reinforce.training.slots import Slots, compile_slots


@dataclasses.dataclass(frozen=True)
class Settings:
    """Train the presets and compare them with the programs' own curves."""

    preset: tuple[str, ...] = tuple(PRESETS)
    """Which presets."""
    seeds: int = 64
    """Seeds trained together."""
    max_updates: int | None = None
    """Stop early; later counts are left out."""


def main() -> None:
    """Trains, compares and prints."""
    settings = tyro.cli(
        Settings, prog="python -m experiments.studies.reproduce", description=__doc__
    )
    jax.config.update("jax_default_matmul_precision", "highest")
    for title, rows in run(settings).items():
        if rows:
            cells = [[_format(x) for x in row.values()] for row in rows]
            print(f"{title}\n\n{table([key.replace('_', ' ') for key in rows[0]], cells)}\n")
    print(
        f"agrees: p >= {LEVEL}, of a rank test over seeds by permutation, two-sided. "
        f"Low, high: 2.5 and 97.5% of our {settings.seeds} seeds; inside: of theirs, between them."
    )


def run(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Trains; returns the rows of the agreement and of the repairs."""
    reference = load_reference()
    chosen = [limit(case, settings.max_updates) for case in CASES if case.preset in settings.preset]
    agreement, repairs = [], []
    for case in chosen:
        print(f"== {case.title}", flush=True)
        scores = train(case, settings_of(case, settings.seeds))
        if case.repair is not None:
            repaired = train(case, settings_of(case, settings.seeds, case.repair[1]))
            repairs += compare_repair(case, scores, repaired)
        for name in case.references:
            agreement += compare(case, name, reference[name], scores)
        if case.stale:
            stale = train(case, settings_of(case, settings.seeds), stale=True)
            name = case.references[0]
            agreement += compare(case, name, reference[name], stale, f"{case.preset}, {STALE}")
    return {"agreement": agreement, "repairs": repairs}


def settings_of(case: Case, num_seeds: int, algorithm: str | None = None) -> Config:
    """Returns the settings of a run: evaluated after every update, or as good as never."""
    scored = case.score == "eval_return"
    config = dataclasses.replace(
        PRESETS[case.preset][1], num_seeds=num_seeds, max_updates=case.updates, **case.changes
    )
    every = 1 if scored else min(50, case.updates)
    episodes = config.eval_episodes if scored else 1
    algorithm = algorithm or config.algorithm
    return dataclasses.replace(
        config, eval_every=every, eval_episodes=episodes, algorithm=algorithm
    )


def train(case: Case, config: Config, *, stale: bool = False) -> np.ndarray:
    """Trains all seeds together; returns the score [U, S] of every update.

    The policy is the program's, also where ``config`` has another algorithm in its place.
    """
    assert config.max_updates is not None
    env = envs.make(config.env)
    published = dataclasses.replace(config, algorithm=PRESETS[case.preset][1].algorithm)
    policy = build_policy(policy_settings(env, published))
    built = build(env, config, policy)
    learner = built.learner
    if stale:
        learner = stale_starts(lambda env: build(env, config, policy).learner, env)
    programs = programs_of(
        env,
        lambda _: learner,
        built.horizon,
        built.training_horizon,
        config,
        config.num_seeds,
    )
    compiled = compile_slots(programs, config, config.num_seeds)
    slots = Slots(compiled, config.first_seed + np.arange(config.num_seeds))
    scores = []
    for _ in range(-(-config.max_updates // config.eval_every)):
        [measured] = slots.advance(evaluate=False)
        if case.score == "eval_return":
            scores.append(slots.evaluate().eval_metrics[case.score][None])
        else:
            scores.append(measured.metrics[case.score])
    return np.concatenate(scores)[: config.max_updates]


def _format(value: Any) -> str:
    if isinstance(value, int) or (isinstance(value, float) and value >= 1000):
        return f"{value:,.0f}"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
