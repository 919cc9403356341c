"""Kills one of two processes at random moments, and looks at the other; then goes on with the run.

``python -m experiments.checks.process_kills --kills 10`` trains InvertedPendulum in two processes
on this machine, again and again: one is killed (SIGKILL), the other must end by itself with status
1 and name the one that died; then ``--resume`` in two processes must end with the same bytes as a
run that was left alone. ``--program train`` does so with a run instead of a sweep. The exit status
is 1 if anything else happened.
"""

import argparse
import contextlib
import json
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

RUN = ["--env", "InvertedPendulum-v5", "--num-seeds", "4", "--hidden-sizes", "4"]
RUN += ["--env-steps", "1500000", "--checkpoint-every", "20"]
PROGRAMS = {
    "sweep": [*RUN, "--over", "learning-rate", "0.01", "0.03", "--chunk-runs", "4"],
    "train": RUN,
}
#: What is to be the same, and what says that a run was begun.
RESULTS = {"sweep": ("results.csv", "curves.npz"), "train": ("returns.npz", "policy/actor.npz")}
BEGUN = {"sweep": "sweep.json", "train": "config.json"}
HERE = "are here"
#: A process that waits longer than this (s) for another that died is hung.
HUNG = 120


class Pair(NamedTuple):
    """Two processes of a run, and the files that their words go to."""

    processes: list[subprocess.Popen]
    outputs: list[Path]

    def said(self, index: int) -> str:
        """Returns what a process said so far."""
        return self.outputs[index].read_text()

    def wait_for_both(self) -> None:
        """Waits until each knows of the other."""
        while not all(HERE in self.said(i) for i in range(2)):
            if all(process.poll() == 0 for process in self.processes):
                return  # it is finished
            if any(process.poll() for process in self.processes):
                sys.exit(f"a process failed: {self.said(0)} {self.said(1)}")
            time.sleep(0.01)


def start(program: str, run: Path) -> Pair:
    """Starts a run, or goes on with it, in two processes."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    begun = (run / BEGUN[program]).exists()
    command = [sys.executable, "-m", f"mjx_reinforce.{program}"]
    command += ["--resume", run.name] if begun else [*PROGRAMS[program], "--output", run.name]
    command += ["--distributed", "--coordinator", f"localhost:{port}", "--num-processes", "2"]
    outputs = [Path(tempfile.mkstemp(dir=run.parent, suffix=".txt")[1]) for _ in range(2)]
    processes = []
    for index, output in enumerate(outputs):
        with output.open("wb") as file:
            each = [*command, "--process-id", str(index)]
            processes.append(subprocess.Popen(each, cwd=run.parent, stdout=file, stderr=file))
    return Pair(processes, outputs)


def finish(program: str, run: Path) -> float:
    """Trains a run to its end; returns how long that took after both processes met (s)."""
    pair = start(program, run)
    pair.wait_for_both()
    began = time.monotonic()
    codes = [process.wait() for process in pair.processes]
    if codes != [0, 0]:
        sys.exit(f"exit status {codes}: {pair.said(0)} {pair.said(1)}")
    return time.monotonic() - began


def kill(pair: Pair, victim: int) -> tuple[float, list[str]]:
    """Kills a process; returns how long the other lived on (s), and what was wrong with its end."""
    name = f"process {victim} (host {socket.gethostname()}, pid {pair.processes[victim].pid})"
    pair.processes[victim].send_signal(signal.SIGKILL)
    began, other = time.monotonic(), 1 - victim
    try:
        code = pair.processes[other].wait(timeout=HUNG)
    except subprocess.TimeoutExpired:
        pair.processes[other].kill()
        return HUNG, ["it hung"]
    seconds, said = time.monotonic() - began, pair.said(other)
    wrong = [] if code == 1 else [f"exit status {code}"]
    wrong += [] if f"error: {name} is gone" in said else [f"it does not name {name}"]
    wrong += ["a traceback"] if "Traceback" in said else []
    return seconds, [*wrong, said[-1000:]] if wrong else []


def differing(run: Path, whole: dict[str, bytes]) -> list[str]:
    """Returns which files of a run are not those of the one that was left alone."""
    return [f"{name} differs" for name in whole if (run / name).read_bytes() != whole[name]]


def state(program: str, run: Path) -> str:
    """Returns what there is of a run."""
    if not (run / BEGUN[program]).exists():
        return "nothing begun"
    if program == "train":
        return f"{len(list(run.glob('checkpoint/*.npz')))} checkpoints"
    status = json.loads((run / "sweep.json").read_text())["status"]
    parts, saved = (len(list(run.glob(f"parts/{name}"))) for name in ("[0-9]*.npz", "*/*.npz"))
    return f"{status}, {parts} chunks ended, {saved} checkpoints"


def main() -> None:
    """Runs, kills, resumes, compares; the exit status is 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", choices=PROGRAMS, default="sweep")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    settings = parser.parse_args()
    program, draw = settings.program, random.Random(settings.seed)
    directory = Path(tempfile.mkdtemp(prefix="process-kills-"))
    for name in ("first", "whole"):  # the second finds compiled programs, as those killed do
        longest = finish(program, directory / name)
    whole = {name: (directory / "whole" / name).read_bytes() for name in RESULTS[program]}
    wrong, lived, number = [], [], 0
    while len(lived) < settings.kills:
        run, pair = directory / f"killed-{number}", start(program, directory / f"killed-{number}")
        pair.wait_for_both()
        after, victim, number = draw.uniform(0, longest), draw.randrange(2), number + 1
        began = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            pair.processes[0].wait(timeout=after)
            longest = time.monotonic() - began  # it ended before
            continue
        if pair.processes[1].poll() is not None:  # the first writes the report
            pair.processes[0].wait()
            continue
        seconds, bad = kill(pair, victim)
        if pair.processes[1 - victim].returncode == 0:  # all had been done: it is to be there
            wrong += differing(run, whole)
            continue
        lived.append(seconds)
        left = state(program, run)
        finish(program, run)
        bad += differing(run, whole)
        wrong += bad
        print(
            f"{len(lived)}: process {victim} killed after {after:.1f} s; the other ended "
            f"{seconds:.2f} s later; {left}; resumed: {bad or 'the same bytes'}",
            flush=True,
        )
    print(f"left alone {longest:.1f} s; {len(lived)} kills of a {program}, {len(wrong)} wrong")
    print(f"the other lived on for {statistics.median(lived):.2f} s, at most {max(lived):.2f} s")
    print(f"see {directory}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
