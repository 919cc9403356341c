"""Kills a sweep at random moments, resumes it each time, and compares it with one left alone.

``python -m experiments.checks.sweep_kills --kills 20`` prints what met each kill, and whether
results.csv and curves.npz are the same bytes in the end.
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

SWEEP = ["--env", "CartPole-v1", "--horizon", "50", "--num-seeds", "8", "--chunk-runs", "12"]
SWEEP += ["--over", "learning-rate", "3e-3", "1e-2", "3e-2", "--hidden-sizes", "4"]
SWEEP += ["--over", "estimator", "leave-one-out", "reward-to-go"]
SWEEP += ["--env-steps", "500000", "--eval-episodes", "2", "--checkpoint-every", "10"]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def start(directory: Path, *arguments: str) -> subprocess.Popen:
    """Starts a sweep whose output goes to a file."""
    command = [sys.executable, "-m", "mjx_reinforce.sweep", *arguments]
    with (directory / "output.txt").open("ab") as output:
        return subprocess.Popen(command, cwd=directory, stdout=output, stderr=output)


def arguments_for(sweep: Path) -> list[str]:
    """Returns the command line that starts a sweep, or goes on with it."""
    if (sweep / "sweep.json").exists():
        return ["--resume", sweep.name]
    return [*SWEEP, "--output", sweep.name]


def state(sweep: Path) -> str:
    """Returns what there is of a sweep."""
    if not (sweep / "sweep.json").exists():
        return "nothing begun"
    status = json.loads((sweep / "sweep.json").read_text())["status"]
    parts = len(list(sweep.glob("parts/[0-9]*.npz")))
    saved = len(list(sweep.glob("parts/*/*.npz")))
    return f"{status}, {parts} chunks ended, {saved} checkpoints"


def results(sweep: Path) -> dict[str, bytes]:
    """Returns the contents of the files that are to be equal."""
    return {name: (sweep / name).read_bytes() for name in ("results.csv", "curves.npz")}


def kill_at_random(sweep: Path, kills: int, longest: float, draw: random.Random) -> list[Path]:
    """Starts, kills and resumes a sweep; returns those that ended before they were killed."""
    killed, ended = 0, []
    while killed < kills:
        process, number = start(sweep.parent, *arguments_for(sweep)), draw.choice(SIGNALS)
        try:
            process.wait(timeout=draw.uniform(0, longest))
            if process.returncode != 0:
                sys.exit(f"status {process.returncode} without a kill, see {sweep.parent}")
            ended.append(sweep.rename(sweep.with_name(f"ended-{len(ended)}")))
        except subprocess.TimeoutExpired:
            killed += 1
            process.send_signal(number)
            code = process.wait()
            print(f"{killed}: {number.name}, exit status {code}, {state(sweep)}", flush=True)
    return ended


def main() -> None:
    """Runs, kills, resumes, compares; the exit status is 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    settings = parser.parse_args()
    directory = Path(tempfile.mkdtemp(prefix="sweep-kills-"))
    for name in ("first", "whole"):  # the second finds compiled programs, as most of those killed
        began = time.monotonic()
        if start(directory, *SWEEP, "--output", name).wait() != 0:
            sys.exit(f"the sweep that is left alone failed, see {directory}")
    longest, sweep = time.monotonic() - began, directory / "killed"
    ended = kill_at_random(sweep, settings.kills, longest, random.Random(settings.seed))
    if start(directory, *arguments_for(sweep)).wait() != 0:
        sys.exit(f"the last resume failed, see {directory}")
    whole = results(directory / "whole")
    differing = [
        f"{path.name}: {name}"
        for path in (directory / "first", sweep, *ended)
        for name, content in results(path).items()
        if content != whole[name]
    ]
    print(f"{settings.kills} kills, {len(ended) + 1} sweeps ended (left alone: {longest:.1f} s)")
    print(f"differing: {differing or 'nothing'}; see {directory}")
    alarms = (directory / "output.txt").read_text().count("Traceback")
    print(f"tracebacks: {alarms}")
    sys.exit(1 if differing or alarms else 0)


if __name__ == "__main__":
    main()
