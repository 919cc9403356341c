"""The runs of the results, each as a program of its own."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.studies.results.tasks import Task, settings_of
from mjx_reinforce.files import read_json
from mjx_reinforce.settings.config import flag


def train(tasks: Sequence[Task], directory: Path) -> int:
    """Trains tasks, one after the other; returns the exit status."""
    for task in tasks:
        if ended(directory / task.name):
            print(f"{task.name} is trained", flush=True)
            continue
        print(f"== {task.name}", flush=True)
        if code := subprocess.call(command(task, directory / task.name)):
            return code
    return 0


def command(task: Task, directory: Path) -> list[str]:
    """Returns the command line that trains a task, or goes on with it."""
    start = [sys.executable, "-m", "mjx_reinforce.train"]
    if (directory / "config.json").exists():
        return [*start, "--resume", str(directory)]
    config, words = settings_of(task), [*start, "--env", task.env]
    for name in dict.fromkeys((*task.settings, "num_seeds", "seed", "env_steps", "eval_every")):
        value = getattr(config, name)
        words += [flag(name), *map(str, value if isinstance(value, tuple) else [value])]
    return [*words, "--output", str(directory)]


def ended(directory: Path) -> bool:
    """Returns whether a run was trained to its end: its budget, or that of finite numbers."""
    return _status(directory) in ("finished", "stopped")


def has_policies(directory: Path) -> bool:
    """Returns whether a run ended, or was interrupted and left its policies."""
    return _status(directory) not in (None, "running") and (directory / "policy").is_dir()


def _status(directory: Path) -> str | None:
    path = directory / "summary.json"
    return read_json(path)["status"] if path.exists() else None
