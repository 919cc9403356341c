"""Kills a run in each of its phases, resumes it each time, and compares how it ends.

``python -m experiments.checks.kills --kills 200`` makes chains of kills: each chain kills and
resumes one run, and then lets it end. It chooses the phase of a kill, then a random moment in it,
then SIGKILL, SIGTERM or SIGINT, of which half of the last two come twice. In the end the policies,
the returns, summary.json but its clocks, and metrics.csv but its clock must be the same bytes. It
prints a table by phase and signal, and exits with 1 if anything else happened than README.md
promises.
"""

import argparse
import collections
import contextlib
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from experiments.kit.trainings import COMMANDS, Training, results, status

#: The phases of a chain of 20 kills. The first two find no run; in "cold" ones XLA compiles, since
#: the compilation cache is empty.
FIRST = ["starting", "cold"]
THEN = ["starting"] * 3 + ["compiling"] * 3 + ["cold"] + ["training"] * 4 + ["writing"] * 4
LAST = ["ending"] * 3
#: A training goes on for so long (s) at most before it is killed: a chain is one training.
LONGEST_TRAINING = 0.7
#: What a signal may make of a process; before its first line it is Python's default.
STATUS = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}
PACKAGE = "mjx_reinforce"
ALARMS = ("Traceback", "Segmentation", "Fatal", "Exception ignored", "rror:")


class Kill(NamedTuple):
    """One kill: where and how, the exit status, seconds from signal to exit, and what is left."""

    phase: str
    signals: str
    status: int
    seconds: float
    left: str


def alone(run: Path, command: tuple[str, str], cache: Path) -> dict[str, float]:
    """Trains without a kill; returns how long each phase took (s)."""
    training, last, lengths = Training(run, *command, cache=cache), time.monotonic(), {}
    for phase, following in (
        ("starting", ("compiling",)),
        ("compiling", ("training", "writing", "ending")),
        ("training", ("ending",)),
        ("ending", ()),
    ):
        training.reach(*following, pause=0.01)
        lengths[phase], last = time.monotonic() - last, time.monotonic()
    if training.process.wait() != 0:
        sys.exit(f"the run that is left alone failed: {training.said()}")
    return lengths


def wait_for(
    training: Training, phase: str, lengths: dict[str, float], draw: random.Random
) -> str | None:
    """Waits for a random moment in a phase; returns the phase it then is in, None if it ended."""
    if phase in ("training", "writing"):
        events, longest = ("training", "writing"), LONGEST_TRAINING
    else:
        events, longest = ("compiling" if phase == "cold" else phase,), lengths[phase]
    if not training.reach(*events, pause=0.005):
        return None
    with contextlib.suppress(subprocess.TimeoutExpired):
        training.process.wait(timeout=draw.uniform(0, longest))
    if phase == "writing" and training.phase() != "ending":
        while training.process.poll() is None and not training.parts():
            pass
        reached = "writing"
        time.sleep(draw.choice([0, draw.uniform(0, 1e-3)]))
    else:
        reached = training.phase()
    return reached if training.process.poll() is None else None


def kill(training: Training, phase: str, draw: random.Random) -> Kill:
    """Sends one signal or two; returns what came of it."""
    process = training.process
    number = draw.choice(list(STATUS))
    twice = number != signal.SIGKILL and draw.random() < 0.5
    process.send_signal(number)
    begun = time.monotonic()
    if twice:
        try:
            process.wait(timeout=draw.uniform(0, 0.3))
        except subprocess.TimeoutExpired:
            process.send_signal(number)
    code = process.wait(timeout=120)
    seconds, parts = time.monotonic() - begun, training.parts()
    left = status(training.run) + (", a part of a file" if parts else "")
    return Kill(phase, number.name + " twice" * twice, code, seconds, left)


def faults(met: Kill, number: int, said: str) -> list[str]:
    """Returns what should not have happened at a kill."""
    ended = met.phase == "ending" and "finished" in met.left
    early = met.phase == "starting" and met.status == -number
    # Before our first line Python shows a traceback of its own.
    found = [alarm for alarm in ALARMS if alarm in said and not (early and PACKAGE not in said)]
    if met.status != STATUS[signal.Signals(number)] and not early and not ended:
        found.append(f"exit status {met.status}")
    if met.signals in ("SIGINT", "SIGTERM") and met.phase in ("training", "writing"):
        found += [] if met.left == "interrupted" else [f"left {met.left}"]
    return found


def main() -> None:
    """Runs, kills, resumes, compares; the exit status is 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--env", default="InvertedPendulum-v5")
    parser.add_argument("--command", choices=COMMANDS, default="train")
    settings = parser.parse_args()
    command = (settings.command, settings.env)
    draw, directory = random.Random(settings.seed), Path(tempfile.mkdtemp(prefix="kills-"))
    cache = directory / "cache"
    cold, warm = (alone(directory / name, command, cache) for name in ("first", "whole"))
    lengths = warm | {"cold": cold["compiling"]}
    print(*(f"{name} {seconds:.1f} s" for name, seconds in lengths.items()), sep=", ", flush=True)
    whole, kills, wrong, ended = results(directory / "whole"), [], [], []
    run = directory / "killed"

    def end(training: Training) -> None:
        code = training.process.wait()
        ours = {} if code else results(run)
        differing = [name for name in ours if ours[name] != whole[name]]
        if code or differing or any(alarm in training.said() for alarm in ALARMS):
            wrong.append(f"{training.said()[-500:]}\nexit status {code}, differing: {differing}")
        ended.append(run.rename(directory / f"ended-{len(ended)}"))

    while len(kills) < settings.kills:
        for phase in [*FIRST, *draw.sample(THEN, len(THEN)), *LAST]:
            used = Path(tempfile.mkdtemp(dir=directory)) if phase == "cold" else cache
            training = Training(run, *command, cache=used)
            reached = wait_for(training, phase, lengths, draw)
            if reached is None:
                end(training)
                continue
            met = kill(training, reached, draw)
            kills.append(met)
            number = signal.Signals[met.signals.split()[0]]
            bad = faults(met, number, training.said())
            wrong += [f"{met}: {bad}; {training.said()[-500:]}"] if bad else []
            print(f"{len(kills)}: {phase} {met} {bad or ''}", flush=True)
        if run.exists():
            end(Training(run, *command, cache=cache))
    report(kills, len(ended), wrong)
    print(f"see {directory}")
    sys.exit(1 if wrong else 0)


def report(kills: list[Kill], ended: int, wrong: list[str]) -> None:
    """Prints for each phase and signal how many, the exit statuses, times, and what was left."""
    groups = collections.defaultdict(list)
    for met in kills:
        groups[met.phase, met.signals].append(met)
    for (phase, signals), group in sorted(groups.items()):
        seconds = [met.seconds for met in group]
        print(
            f"{phase:9} {signals:13} {len(group):3} kills; "
            f"exit status {_counts(met.status for met in group)}; "
            f"median {statistics.median(seconds):.2f} s, longest {max(seconds):.2f} s; "
            f"left {_counts(met.left for met in group)}"
        )
    print(f"{len(kills)} kills, {ended} runs ended, {len(wrong)} things wrong", *wrong, sep="\n")


def _counts(values: Iterable[object]) -> str:
    return ", ".join(f"{value}: {n}" for value, n in collections.Counter(values).items())


if __name__ == "__main__":
    main()
