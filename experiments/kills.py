"""Kills a run at random moments, resumes it each time, and compares its end with a run left alone.

``python experiments/kills.py --kills 20`` prints what met each kill, and whether the policies, the
returns, and all of metrics.csv but the clock are the same bytes in the end.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RUN = ["--env", "InvertedPendulum-v5", "--horizon", "50", "--env-steps", "600000"]
RUN += ["--hidden-sizes", "4", "--eval-episodes", "2", "--checkpoint-every", "5"]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def start(directory: Path, *arguments: str) -> subprocess.Popen:
    """Starts a training process whose output goes to a file."""
    command = [sys.executable, "-m", "mjx_reinforce.train", *arguments]
    with (directory / "output.txt").open("ab") as output:
        return subprocess.Popen(command, cwd=directory, stdout=output, stderr=output)


def results(directory: Path) -> dict[str, object]:
    """Returns what a run leaves, but for its clocks."""
    rows = [line.split(",") for line in (directory / "metrics.csv").read_text().splitlines()]
    clock = rows[0].index("wall_seconds")
    summary = json.loads((directory / "summary.json").read_text())
    clocks = ("compile_seconds", "run_seconds", "env_steps_per_second")
    with np.load(directory / "returns.npz", allow_pickle=False) as archive:
        training = {name: archive[name].tobytes() for name in archive.files}
    return {
        "metrics.csv": [row[:clock] + row[clock + 1 :] for row in rows],
        "policy": (directory / "policy" / "actor.npz").read_bytes(),
        "policy/best": (directory / "policy" / "best" / "actor.npz").read_bytes(),
        "returns.npz": training,
        "summary.json": {name: x for name, x in summary.items() if name not in clocks},
    }


def status(run: Path) -> str:
    """Returns what a run says of itself: its status, or how little of it there is."""
    if not (run / "config.json").exists():
        return "nothing begun"
    path = run / "summary.json"
    return json.loads(path.read_text())["status"] if path.exists() else "no checkpoint yet"


def arguments_for(run: Path) -> list[str]:
    """Returns the command line that starts a run, or goes on with it."""
    if (run / "config.json").exists():
        return ["--resume", run.name]
    return [*RUN, "--output", run.name]


def main() -> None:
    """Runs, kills, resumes, compares; the exit status is 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    settings = parser.parse_args()
    draw = random.Random(settings.seed)
    directory = Path(tempfile.mkdtemp(prefix="kills-"))
    for name in ("first", "whole"):  # the second finds compiled programs, as most of those killed
        begun = time.monotonic()
        if start(directory, *RUN, "--output", name).wait() != 0:
            sys.exit(f"the run that is left alone failed, see {directory}")
    longest = time.monotonic() - begun
    run, kills, finished = directory / "killed", 0, []
    while kills < settings.kills:
        process, number = start(directory, *arguments_for(run)), draw.choice(SIGNALS)
        try:
            process.wait(timeout=draw.uniform(0, longest))
            if process.returncode != 0:
                sys.exit(f"status {process.returncode} without a kill, see {directory}")
            finished.append(run.rename(directory / f"finished-{len(finished)}"))
        except subprocess.TimeoutExpired:
            kills += 1
            process.send_signal(number)
            code = process.wait()
            print(f"{kills}: {number.name}, exit status {code}, {status(run)}", flush=True)
    if start(directory, *arguments_for(run)).wait() != 0:
        sys.exit(f"the last resume failed, see {directory}")
    whole = results(directory / "whole")
    differing = [
        f"{path.name}: {name}"
        for path in (run, *finished)
        for name, value in results(path).items()
        if value != whole[name]
    ]
    text = (directory / "output.txt").read_text()
    print(f"{kills} kills, {len(finished) + 1} runs ended; differing: {differing or 'nothing'}")
    print(f"tracebacks: {text.count('Traceback')}, alarms: {text.count('Error')}; see {directory}")
    sys.exit(1 if differing or "Traceback" in text else 0)


if __name__ == "__main__":
    main()
