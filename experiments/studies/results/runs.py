"""The runs and sweeps of the results."""

import contextlib
import dataclasses
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.studies.results.tasks import Task, settings_of, sweep_settings_of
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.files import read_json
from mjx_reinforce.settings.config import Config, flag
from mjx_reinforce.settings.relevance import is_read
from mjx_reinforce.sweeps.designs.design import Design, read_design
from mjx_reinforce.sweeps.perform import perform

#: Each setting is moved by this factor either way.
FACTOR = 3
#: The settings that are moved, and whether they count something.
_MOVED = {
    "learning_rate": False,
    "max_kl": False,
    "discount": False,
    "initial_std": False,
    "standardize_floor": False,
    "momentum": False,
    "normalize_min_std": False,
    "num_episodes": True,
    "decay_steps": True,
    "decay_updates": True,
}


def train(tasks: Sequence[Task], directory: Path) -> int:
    """Trains tasks, one after the other, each as a program of its own; returns the exit status."""
    for task in tasks:
        if ended(directory / task.name):
            print(f"{task.name} is trained", flush=True)
            continue
        print(f"== {task.name}", flush=True)
        if code := _wait(command(task, directory / task.name)):
            return code
    return 0


def command(task: Task, directory: Path) -> list[str]:
    """Returns the command line that trains a task, or goes on with it."""
    start = [sys.executable, "-m", "mjx_reinforce.train"]
    if (directory / "config.json").exists():
        return [*start, "--resume", str(directory)]
    config = settings_of(task, task.seeds, task.env_steps)
    words = [*start, "--env", task.env]
    for name in dict.fromkeys((*task.settings, "num_seeds", "seed", "env_steps", "eval_every")):
        value = getattr(config, name)
        words += [flag(name), *map(str, value if isinstance(value, tuple) else [value])]
    return [*words, "--output", str(directory)]


def ended(directory: Path) -> bool:
    """Returns whether a run was trained to its end: its budget, or that of finite numbers."""
    path = directory / "summary.json"
    return path.exists() and read_json(path)["status"] in ("finished", "stopped")


def _wait(words: Sequence[str]) -> int:
    """Runs a program to its end; Ctrl-C reaches it too, and it ends with its files written."""
    with subprocess.Popen(words) as program:
        while program.poll() is None:
            with contextlib.suppress(KeyboardInterrupt):
                program.wait()
    return program.returncode


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneAtATime(Design):
    """A sweep of the base's settings, and of each value of ``over`` alone beside them."""

    def count(self) -> int:
        """Returns how many configurations there are."""
        return len(self.configurations())

    def configurations(self) -> list[dict[str, Any]]:
        """Returns the base's values first, then those with one of them changed."""
        base = {name: getattr(self.base, name) for name in self.over}
        changed = [(k, x) for k, values in self.over.items() for x in values if x != base[k]]
        return [base, *({**base, name: value} for name, value in changed)]


def sensitivity(tasks: Sequence[Task], directory: Path) -> int:
    """Trains the sweeps of tasks, one after the other; returns the exit status."""
    for task in tasks:
        place = directory / "sensitivity" / task.name
        begun = (place / "sweep.json").exists()
        if swept(place):
            print(f"the settings of {task.name} are swept", flush=True)
            continue
        print(f"== {task.name}", flush=True)
        base = sweep_settings_of(task, task.sweep_seeds, task.sweep_steps)
        if begun:
            base = read_design(place).base
        design = OneAtATime(
            base=dataclasses.replace(base, output=place),
            over=moves(base),
            resume=place if begun else None,
        )
        with Interrupt() as interrupt:
            perform(design, interrupt, [], report=False)
            if interrupt.number is not None:
                return 128 + interrupt.number
    return 0


def swept(directory: Path) -> bool:
    """Returns whether a sweep has ended."""
    path = directory / "sweep.json"
    return path.exists() and read_json(path)["status"] == "finished"


def moves(base: Config) -> Mapping[str, list[Any]]:
    """Returns the values of every setting that a base has and reads: less, its own, and more.

    A discount and a momentum move by their distance from 1.
    """
    found: dict[str, list[Any]] = {}
    for name, counts in _MOVED.items():
        value = getattr(base, name)
        if value is None or isinstance(value, str) or not is_read(name, base):
            continue
        values = [_moved(name, value, factor, counts) for factor in (1 / FACTOR, 1, FACTOR)]
        found[name] = list(dict.fromkeys(values))
    return {name: values for name, values in found.items() if len(values) > 1}


def _moved(name: str, value: Any, factor: float, counts: bool) -> Any:
    """Returns a value times a factor; of the discount and the momentum, nearer to 1 is "more"."""
    if factor == 1:
        return value
    if name in ("discount", "momentum"):
        return max(0.0, round(1 - (1 - value) / factor, 12))
    return max(2, round(value * factor)) if counts else float(f"{value * factor:.6g}")
