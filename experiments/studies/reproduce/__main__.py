"""Do the presets learn as the programs they are named after? Their curves and ours, and a test.

    python -m experiments.studies.reproduce --curves runs/reproduce --json rows.json
    python -m experiments.studies.reproduce --preset categorical-cartpole --seeds 16

The programs' own curves, a few seeds each, are in reference.json. Ours come from many seeds that
train together. Where a program has a mistake that can be taken out, so do as many without it.
"""

import dataclasses
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table

from experiments.studies.reproduce.cases import CASES, Case, limit, load_reference
from experiments.studies.reproduce.figures import draw
from experiments.studies.reproduce.mistakes import STALE, clamped, stale_starts
from experiments.studies.reproduce.statistics import LEVEL, compare, compare_repair
from mjx_reinforce import envs
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.presets import PRESETS
from mjx_reinforce.store.build import build, policy_settings
from mjx_reinforce.training.programs import compile_run, programs_of
from mjx_reinforce.training.state import budget_of

_TUTORIAL = "gymnasium-tutorial"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Train the presets and compare them with the programs' own curves."""

    preset: tuple[str, ...] = tuple(PRESETS)
    """Which presets."""
    seeds: int = 64
    """Seeds trained together."""
    max_updates: int | None = None
    """Stop early; later counts are left out."""
    repairs: bool = True
    """Also train without the programs' mistakes."""
    clamp: bool = False
    """Give truncated Normals the clamped density of torchrl, see ``clamped_log_prob``."""
    timing: bool = True
    """Also time the tutorial's experiment, 5 seeds of 5,000 episodes."""
    curves: Path | None = None
    """Folder that keeps returns; what lies there is not trained again, and not looked into."""
    figures: Path = Path("documents")
    """Folder for the figures."""
    json: Path | None = None
    """Where to write the rows."""


def main() -> None:
    """Trains, compares, prints, draws and writes."""
    settings = tyro.cli(
        Settings, prog="python -m experiments.studies.reproduce", description=__doc__
    )
    jax.config.update("jax_default_matmul_precision", "highest")
    results = run(settings)
    for title, rows in results.items():
        show(title, rows)
    print(
        f"agrees: p >= {LEVEL}, of a rank test over seeds by permutation, two-sided. "
        f"Low, high: 2.5 and 97.5 % of our {settings.seeds} seeds; inside: of theirs, between them."
    )
    if settings.json:
        settings.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def run(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Trains and draws; returns the rows of the agreement, of the repairs and of the times."""
    reference = load_reference()
    chosen = [limit(case, settings.max_updates) for case in CASES if case.preset in settings.preset]
    agreement, repairs, panels = [], [], []
    for case in chosen:
        scores = train_case(case, settings)
        repaired = None
        if case.repair is not None and settings.repairs:
            repaired = train_case(case, settings, *case.repair)
            repairs += compare_repair(case, scores, repaired)
        for name in case.references:
            agreement += compare(case, name, reference[name], scores)
        stale = None
        if case.stale and settings.repairs:
            stale = train_case(case, settings, STALE, stale=True)
            name = case.references[0]
            agreement += compare(case, name, reference[name], stale, f"{case.preset}, {STALE}")
        panels.append((case, scores, repaired, stale))
        same = [panel for panel in panels if panel[0].document == case.document]
        settings.figures.mkdir(parents=True, exist_ok=True)
        draw(settings.figures / f"{case.document}.png", same, reference)
    times = []
    if settings.timing and _TUTORIAL in settings.preset:
        times = [time_tutorial(reference["003"], settings.max_updates)]
    return {"agreement": agreement, "repairs": repairs, "times": times}


def settings_of(case: Case, num_seeds: int, changes: Mapping[str, Any]) -> Config:
    """Returns the settings of a run: evaluated after every update, or as good as never."""
    scored = case.score == "eval_return"
    config = dataclasses.replace(
        PRESETS[case.preset][1], num_seeds=num_seeds, max_updates=case.updates, **case.changes
    )
    every = 1 if scored else min(50, case.updates)
    episodes = config.eval_episodes if scored else 1
    return dataclasses.replace(config, eval_every=every, eval_episodes=episodes, **changes)


def train_case(
    case: Case,
    settings: Settings,
    label: str = "",
    changes: Mapping[str, Any] | None = None,
    *,
    stale: bool = False,
) -> np.ndarray:
    """Returns the score [U, S] of every update, from the folder of curves if it is there."""
    config = settings_of(case, settings.seeds, changes or {})
    digest = hashlib.sha256(
        repr((config, case.score) + (stale,) * stale + ("clamp",) * settings.clamp).encode()
    ).hexdigest()[:12]
    kept = settings.curves and settings.curves / f"{config.env}-{digest}.npy"
    if kept and kept.exists():
        return np.load(kept, allow_pickle=False)
    scores, _ = train(
        config,
        case.score,
        f"{case.title}{label and ', '}{label}",
        stale=stale,
        clamp=settings.clamp,
    )
    if kept:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.save(kept, scores, allow_pickle=False)
    return scores


def train(
    config: Config, score: str, label: str, *, stale: bool = False, clamp: bool = False
) -> tuple[np.ndarray, dict[str, Any]]:
    """Trains all seeds together.

    Returns:
      The score [U, S] of every update; ``compile_seconds``, ``run_seconds`` and ``env_steps``.
    """
    assert config.max_updates is not None
    env = envs.make(config.env)
    started = time.perf_counter()
    policy = build_policy(policy_settings(env, config))
    if clamp and config.policy == "truncated-normal":
        policy = clamped(policy, env.action_space)
    learner, horizon = build(env, config, policy)
    if stale:
        learner = stale_starts(lambda env: build(env, config, policy)[0], env)
    traced = programs_of(env, lambda _: learner, horizon, config, config.num_seeds)
    state, programs = compile_run(traced, config)
    compiled, budget = time.perf_counter(), budget_of(config)
    scores, env_steps, columns = [], 0, Progress.get_default_columns()
    with Progress(*columns, MofNCompleteColumn(), TimeElapsedColumn()) as progress:
        bar = progress.add_task(label, total=config.max_updates)
        for _ in range(-(-config.max_updates // config.eval_every)):
            state, metrics, _ = programs.advance(state, False, budget)
            active = np.asarray(metrics["active"])
            env_steps += int(np.sum(np.asarray(metrics["env_steps"]), where=active))
            if score == "eval_return":
                scores.append(programs.evaluate(state).measured[score][None])
            else:
                scores.append(np.asarray(metrics[score]))
            progress.update(bar, completed=min(len(scores) * config.eval_every, config.max_updates))
    seconds = time.perf_counter() - compiled
    times = {"compile_seconds": compiled - started, "run_seconds": seconds, "env_steps": env_steps}
    return np.concatenate(scores)[: config.max_updates], times


def time_tutorial(entry: Mapping[str, Any], max_updates: int | None) -> dict[str, Any]:
    """Times the tutorial's experiment, and the part of it that all seeds on record played."""
    config = PRESETS[_TUTORIAL][1]
    updates = min(config.max_updates or 0, max_updates or 5000)
    config = dataclasses.replace(config, max_updates=updates, eval_every=min(100, updates))
    config = dataclasses.replace(config, eval_episodes=1)
    _, whole = train(config, "episode_return", "the tutorial's experiment, timed")
    common, theirs = entry["common"], sum(entry["common"]["wall_seconds"])
    common_config = dataclasses.replace(config, max_updates=min(common["updates"], updates))
    _, part = train(common_config, "episode_return", "as far as the record goes, timed")
    row = {"seeds": config.num_seeds, "episodes_each": updates, **whole}
    row["env_steps_per_second"] = whole["env_steps"] / whole["run_seconds"]
    row["record_steps_per_second"] = sum(common["env_steps"]) / theirs
    row["ratio_of_steps_per_second"] = row["env_steps_per_second"] / row["record_steps_per_second"]
    row["common_episodes_each"] = common_config.max_updates
    row["record_seconds"] = theirs
    row["ours_seconds"] = part["run_seconds"]
    row["ours_compile_seconds"] = part["compile_seconds"]
    row["ratio_of_seconds"] = theirs / part["run_seconds"]
    row["ratio_with_compiling"] = theirs / (part["run_seconds"] + part["compile_seconds"])
    return row


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a table; one row alone stands upright."""
    if not rows:
        return
    table = Table(title=title)
    if len(rows) == 1:
        rows = [{"what": key.replace("_", " "), "value": value} for key, value in rows[0].items()]
    for key in rows[0]:
        table.add_column(key.replace("_", " "), overflow="fold")
    for row in rows:
        table.add_row(*map(_format, row.values()))
    Console(width=180).print(table)


def _format(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return str(value)


if __name__ == "__main__":
    main()
