"""Fills the disk under a run at many places, makes room again, resumes, and compares the ends.

``python -m experiments.checks.full_disk`` needs root, for it mounts a small file system of its own.
It prints what each run said and left, and exits with 1 where the end differs from that of a run
left alone, or where more was lost than README.md says.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from experiments.kit.trainings import COMMANDS, Training, results, status

ALARMS = ("Traceback", "Exception ignored")
_SIZE = "16m"


class Case(NamedTuple):
    """When the disk becomes full, and how full.

    moment: "start", before the program starts; else the phase of ``Training.phase``
    pages: how many of 4 KiB are left
    resumed: whether the run was killed before, and goes on
    room_after: seconds until there is room again, None for after the run's end
    screen: whether its output goes to the same disk
    """

    moment: str
    pages: int
    resumed: bool = False
    room_after: float | None = None
    screen: bool = False


CASES = [
    Case("start", 0),
    Case("start", 0, screen=True),
    Case("start", 0, resumed=True),
    *(Case("compiling", pages) for pages in (0, 1, 2, 20, 90, 110, 200)),
    Case("compiling", 3, screen=True),
    *(Case("compiling", pages, resumed=True) for pages in (0, 1, 2, 50)),
    *(Case("training", pages) for pages in (0, 1, 20)),
    Case("training", 0, room_after=1.0),
    Case("training", 0, room_after=1.0, screen=True),
    Case("training", 0, screen=True),
    *(Case("ending", pages) for pages in (0, 1, 5)),
    Case("ending", 0, screen=True),
]


def fill(disk: Path, pages: int) -> None:
    """Leaves so many pages of a file system."""
    free = os.statvfs(disk)
    with (disk / "ballast").open("wb", buffering=0) as ballast:
        ballast.write(bytes(max(free.f_bavail - pages, 0) * free.f_bsize))


def meet(case: Case, disk: Path, screen: Path, command: tuple[str, str], cache: Path) -> Training:
    """Trains until the run ends on its full disk, and makes room; returns the process."""
    run, shown = disk / "run", disk if case.screen else screen
    if case.resumed:
        killed = Training(run, *command, cache=cache, screen=screen)
        killed.reach("training", "writing", pause=0.005)
        time.sleep(0.5)
        killed.process.kill()
        killed.process.wait()
    if case.moment == "start":
        fill(disk, case.pages)
    training = Training(run, *command, cache=cache, screen=shown)
    if case.moment != "start":
        training.reach(case.moment, pause=0.001)
        fill(disk, case.pages)
    if case.room_after is not None:
        time.sleep(case.room_after)
        (disk / "ballast").unlink()
    training.process.wait(timeout=300)
    (disk / "ballast").unlink(missing_ok=True)
    return training


def faults(case: Case, disk: Path, whole: dict[str, object], again: Training) -> list[str]:
    """Returns what is wrong with a run that went on after there was room."""
    code = again.process.wait(timeout=300)
    ended = results(disk / "run") if code == 0 else {}
    found = [name for name, value in whole.items() if ended.get(name) != value]
    found += [f"exit status {code} of the resumed run"] if code else []
    return found


def main() -> None:
    """Runs all cases; the exit status is 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--cases", type=int, nargs="*", default=range(len(CASES)))
    parser.add_argument("--command", choices=COMMANDS, default="train")
    settings = parser.parse_args()
    command, wrong = (settings.command, settings.env), 0
    screen = Path(tempfile.mkdtemp(prefix="full-disk-"))
    disk, cache = screen / "disk", screen / "cache"
    disk.mkdir()
    if Training(screen / "whole", *command, cache=cache).process.wait() != 0:
        sys.exit(f"the run that is left alone failed, see {screen}")
    whole = results(screen / "whole")
    for number in settings.cases:
        case = CASES[number]
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_SIZE}", "tmpfs", disk], check=True)
        try:
            training = meet(case, disk, screen, command, cache)
            lines = training.said().splitlines()
            said = [line for line in lines if "error" in line or "warning" in line]
            left = status(disk / "run")
            parts = training.parts()
            again = Training(disk / "run", *command, cache=cache, screen=screen)
            found = faults(case, disk, whole, again)
            found += [alarm for alarm in ALARMS if alarm in training.said() + again.said()]
            goes_on = [line for line in again.said().splitlines() if "going on" in line]
        finally:
            subprocess.run(["umount", disk], check=True)
        wrong += bool(found)
        print(f"{number} {case}: exit status {training.process.returncode}, left {left} {parts}")
        print("  ", *said, *goes_on, f"differing: {found or 'nothing'}", sep="\n    ", flush=True)
    print(f"{len(settings.cases)} cases, {wrong} wrong; see {screen}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
