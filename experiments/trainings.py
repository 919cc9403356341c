"""Training processes of which experiments ask what they do, and what they leave."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

UPDATES = 600
RUN = ["--env-steps", "None", "--max-updates", str(UPDATES), "--hidden-sizes", "64", "64"]
RUN += ["--num-episodes", "2", "--horizon", "20", "--eval-episodes", "1"]
RUN += ["--estimator", "value-baseline", "--value-hidden-sizes", "8", "--value-fits", "1"]
RUN += ["--eval-every", "2", "--checkpoint-every", "2"]
#: Parts of summary.json that a clock decides, or which of two threads was faster.
CLOCKS = ("compile_seconds", "run_seconds", "env_steps_per_second", "useful_step_fraction")


class Training:
    """A training process, and what it has said so far."""

    def __init__(self, run: Path, *arguments: str, cache: Path, screen: Path | None = None):
        """Starts the run, or goes on with it; ``screen`` gets a file of its output."""
        begun = (run / "config.json").exists()
        arguments = ("--resume", run.name) if begun else (*arguments, "--output", run.name)
        self.run = run
        with tempfile.NamedTemporaryFile(
            "wb", dir=screen or run.parent, suffix=".txt", delete=False
        ) as said:
            self._said = Path(said.name)
            self.process = subprocess.Popen(
                [sys.executable, "-m", "mjx_reinforce.train", *arguments],
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
        if "100.0 %" in said or f"going on after {UPDATES} updates" in said:
            return "ending"
        if "compiled in" in said:
            return "writing" if self.parts() else "training"
        return "compiling" if "Training " in said else "starting"

    def parts(self) -> list[str]:
        """Returns the files that are being written, or were when it was killed."""
        folders = [self.run / name for name in ("", "checkpoint", "policy", "policy/best")]
        return [n for f in folders if f.is_dir() for n in os.listdir(f) if n.startswith(".")]

    def reach(self, *phases: str, pause: float) -> bool:
        """Waits for one of these phases; returns whether the process still lives."""
        while self.process.poll() is None and self.phase() not in phases:
            time.sleep(pause)
        return self.process.poll() is None


def results(directory: Path) -> dict[str, object]:
    """Returns what a run leaves, without its clocks."""
    rows = [line.split(",") for line in (directory / "metrics.csv").read_text().splitlines()]
    clock = rows[0].index("wall_seconds")
    summary = json.loads((directory / "summary.json").read_text())
    with np.load(directory / "returns.npz", allow_pickle=False) as archive:
        training = {name: archive[name].tobytes() for name in archive.files}
    return {
        "metrics.csv": [row[:clock] + row[clock + 1 :] for row in rows],
        "policy": (directory / "policy" / "actor.npz").read_bytes(),
        "policy/best": (directory / "policy" / "best" / "actor.npz").read_bytes(),
        "returns.npz": training,
        "summary.json": {name: x for name, x in summary.items() if name not in CLOCKS},
        "parts of files": [path.name for path in directory.rglob(".*")],
    }


def status(run: Path) -> str:
    """Returns what a run says of itself: its status, or how little of it there is."""
    if not (run / "config.json").exists():
        return "nothing begun"
    path = run / "summary.json"
    return json.loads(path.read_text())["status"] if path.exists() else "no checkpoint yet"
