"""The runs of the study: a task after another in one process, each with so many minutes."""

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.kit import rows
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.files import read_json
from mjx_reinforce.reports.sources import read_columns
from mjx_reinforce.runs.design import Design, read_design
from mjx_reinforce.runs.perform import perform
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task

#: The suite's tasks of which REPPO's files have results.
TASKS = (
    *("WalkerRun", "WalkerWalk", "WalkerStand", "HopperHop", "HopperStand", "CheetahRun"),
    *("HumanoidRun", "HumanoidWalk", "HumanoidStand", "CartpoleSwingup", "CartpoleSwingupSparse"),
    *("AcrobotSwingup", "ReacherEasy", "ReacherHard", "FingerSpin", "FishSwim", "BallInCup"),
    *("PendulumSwingup", "SwimmerSwimmer6", "PointMass"),
)
#: Root of all randomness; no settings search used it.
ROOT = 20_261_130
#: Episodes from fresh starts of the policy of each seed, without noise.
TEST_EPISODES = 100
#: Each row is a seed; ``minutes`` is the budget of all seeds together, ``seconds`` what training
#: and its evaluations took of it.
COLUMNS: tuple[str, ...] = (
    *("date", "commit", "device", "jax", "task", "minutes", "seed", "status", "return"),
    *("env_steps", "seconds", "compile_seconds"),
)


def settings_of(task: str, num_seeds: int, minutes: float) -> Config:
    """Returns the settings of a run: the task's defaults, and tests of ``TEST_EPISODES``."""
    config = of_task(f"playground:{task}", num_seeds=num_seeds, minutes=minutes)
    return dataclasses.replace(
        config, seed=ROOT, minutes=minutes, test_episodes=TEST_EPISODES, output=None
    )


def returns_path(folder: Path, task: str, minutes: float) -> Path:
    """Returns where the returns of a run are after so many minutes."""
    return folder / "returns" / f"{task}-{minutes:g}.csv"


def train(tasks: Sequence[str], folder: Path, num_seeds: int, minutes: float) -> bool:
    """Trains tasks, and writes the returns of each at its end; what is there is kept.

    A run that had fewer minutes goes on. One that was stopped does, too. A task that fails is
    named, and the others follow.

    Args:
      tasks: names of Playground's suite.
      folder: FOLDER/TASK is a run.
      num_seeds: of each run.
      minutes: for all seeds of a task together; compiling and the test at the end are not in it.

    Returns:
      Whether all have ended.
    """
    has_all = True
    with Interrupt() as interrupt:
        for task in tasks:
            path = returns_path(folder, task, minutes)
            if path.exists():
                print(f"{task}: {path} is there", flush=True)
                continue
            began = time.perf_counter()
            try:
                design = _design(folder / task, settings_of(task, num_seeds, minutes))
                outcome = perform(design, interrupt, quiet=True)
                status = str(outcome.summary["status"])
                if status != "interrupted":
                    _write(path, folder / task, minutes)
            except (ValueError, RuntimeError, MemoryError) as error:
                status = f"failed, {error}"
            print(f"{task}: {status} after {time.perf_counter() - began:.0f} s", flush=True)
            has_all = has_all and path.exists()
            if interrupt.number is not None:
                return False
            jax.clear_caches()
    return has_all


def _design(run: Path, config: Config) -> Design:
    """Returns what is to be trained: a new run, or what is left of its minutes."""
    if not (run / "config.json").exists():
        return Design(base=dataclasses.replace(config, output=run))
    design = read_design(run)
    summary_path = run / "summary.json"
    # A run that was killed says that it is running.
    if not summary_path.exists() or read_json(summary_path)["status"] in {"interrupted", "running"}:
        # Its budget is that of its minutes, in env steps.
        return design
    assert config.minutes is not None
    minutes_left = config.minutes - trained_seconds(run) / 60
    return dataclasses.replace(design, base=dataclasses.replace(design.base, minutes=minutes_left))


def trained_seconds(run: Path) -> float:
    """Returns how long a run was trained and evaluated (s)."""
    times = read_columns(run / "metrics.csv", {"wall_seconds": np.float64})
    return float(times["wall_seconds"][-1])


def _write(path: Path, run: Path, minutes: float) -> None:
    """Writes the returns of a run that has ended, a row for each seed."""
    config = read_json(run / "config.json")
    summary = read_json(run / "summary.json")
    steps = read_columns(run / "metrics.csv", {"env_steps": np.float64})["env_steps"]
    known: dict[str, Any] = {
        "date": rows.now(),
        "commit": (config["git_commit"] or "unknown")[:12],
        "device": config["device"],
        "jax": jax.__version__,
        "task": run.name,
        "minutes": f"{minutes:g}",
        "status": summary["status"],
        "seconds": f"{trained_seconds(run):.1f}",
        "compile_seconds": f"{summary['compile_seconds']:.1f}",
    }
    # Of a seed one of whose test episodes broke, the summary has none.
    returns = np.array(summary["final_test_returns"], float)
    lines = [
        known | {"seed": seed, "return": f"{mean:.7g}", "env_steps": f"{count:.0f}"}
        for seed, (mean, count) in enumerate(zip(returns, steps[-len(returns) :], strict=True))
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    rows.append(part, lines, COLUMNS)
    part.replace(path)
    # A test that broke counts as 0, as in the table.
    returns = np.where(np.isnan(returns), 0.0, returns)
    print(
        f"  mean {np.mean(returns):.1f}, worst {np.min(returns):.1f}", file=sys.stderr, flush=True
    )
