"""Training processes of which experiments ask what they do, and what they leave."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

UPDATES = 600
_EACH = "--env-steps None --num-episodes 2 --horizon 20 --eval-episodes 1 --eval-every 2"
_EACH += " --checkpoint-every 2 --max-updates"
RUN = [*_EACH.split(), str(UPDATES), "--hidden-sizes", "64", "64"]
RUN += ["--estimator", "value-baseline", "--value-hidden-sizes", "8", "--value-fits", "1"]
SWEEP = [*_EACH.split(), str(UPDATES // 4), "--num-seeds", "2", "--chunk-runs", "2"]
SWEEP += ["--over", "learning-rate", "1e-2", "3e-2", "1e-1"]
#: Command -> its arguments.
COMMANDS = {"train": RUN, "sweep": SWEEP}
#: Parts of summary.json and sweep.json that a clock decides, or which of two threads was faster.
CLOCKS = ("compile_seconds", "run_seconds", "env_steps_per_second", "useful_step_fraction")
CLOCKS += ("command",)


class Training:
    """A process that trains a run or a sweep, and what it has said so far."""

    def __init__(self, run: Path, command: str, env: str, *, cache: Path):
        """Starts a run or sweep, or goes on with it."""
        begun = (run / "config.json").exists() or (run / "sweep.json").exists()
        first = ["--env", env, *COMMANDS[command], "--output", run.name]
        arguments = ["--resume", run.name] if begun else first
        self.run = run
        with tempfile.NamedTemporaryFile("wb", dir=run.parent, suffix=".txt", delete=False) as said:
            self._said = Path(said.name)
            self.process = subprocess.Popen(
                [sys.executable, "-m", f"mjx_reinforce.{command}", *arguments],
                cwd=run.parent,
                env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)},
                stdout=said,
                stderr=said,
            )

    def said(self) -> str:
        """Returns its output and errors."""
        return self._said.read_text()

    def phase(self) -> str:
        """Returns what it does now."""
        said = self.said()
        if any(x in said for x in ("100.0%", f"going on after {UPDATES} updates", "is finished")):
            return "ending"
        if "compiled in" in said:
            return "writing" if self.parts() else "training"
        return "compiling" if "Training " in said or "Sweeping " in said else "starting"

    def parts(self) -> list[str]:
        """Returns the files that are being written, or were when it was killed."""
        folders = [self.run / name for name in ("", "checkpoint", "policy", "policy/best")]
        folders += (self.run / "parts").glob("**")
        with contextlib.suppress(FileNotFoundError):  # a checkpoint that is removed meanwhile
            return [n for f in folders if f.is_dir() for n in os.listdir(f) if n.startswith(".")]
        return []

    def reach(self, *phases: str, pause: float) -> bool:
        """Waits for one of these phases; returns whether the process still lives."""
        while self.process.poll() is None and self.phase() not in phases:
            time.sleep(pause)
        return self.process.poll() is None


def results(directory: Path) -> dict[str, object]:
    """Returns what a run or a sweep leaves, without its clocks."""
    if (directory / "sweep.json").exists():
        return _of_sweep(directory)
    rows = [line.split(",") for line in (directory / "metrics.csv").read_text().splitlines()]
    clock = rows[0].index("wall_seconds")
    return {
        "metrics.csv": [row[:clock] + row[clock + 1 :] for row in rows],
        "policy": (directory / "policy" / "actor.npz").read_bytes(),
        "policy/best": (directory / "policy" / "best" / "actor.npz").read_bytes(),
        "returns.npz": _arrays(directory / "returns.npz"),
        "summary.json": _without_clocks(directory / "summary.json"),
        "parts of files": [path.name for path in directory.rglob(".*")],
    }


def _of_sweep(directory: Path) -> dict[str, object]:
    policies = sorted(directory.glob("policies/*/policy/actor.npz"))
    return {
        "curves.npz": _arrays(directory / "curves.npz"),
        "policies": [path.read_bytes() for path in policies],
        "sweep.json": _without_clocks(directory / "sweep.json"),
        "report.html": (directory / "report.html").exists(),
        "parts of files": [path.name for path in directory.rglob(".*")],
    }


def _arrays(path: Path) -> dict[str, bytes]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name].tobytes() for name in archive.files}


def _without_clocks(path: Path) -> dict[str, object]:
    return {name: x for name, x in json.loads(path.read_text()).items() if name not in CLOCKS}


def status(run: Path) -> str:
    """Returns what a run or a sweep says of itself: its status, or how little of it there is."""
    if (run / "sweep.json").exists():
        return json.loads((run / "sweep.json").read_text())["status"]
    if not (run / "config.json").exists():
        return "nothing begun"
    path = run / "summary.json"
    return json.loads(path.read_text())["status"] if path.exists() else "no checkpoint yet"
