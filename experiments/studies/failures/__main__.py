"""Why do seeds of a network fail on InvertedPendulum, and what mends it?

``python -m experiments.studies.failures train`` trains and measures all arms, about an hour on two
slow cores; ``... train NAME ...`` those alone. ``python -m experiments.studies.failures page``
writes docs/failures.md and its pictures from experiments/studies/failures/data, without training.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.kit.places import DOCS
from experiments.studies.failures import measures
from experiments.studies.failures.arms import ARMS
from experiments.studies.failures.runs import Measured, train

DATA = Path(__file__).parent / "data"
#: Seeds that are trained together; an arm has one or more such parts.
PART = 256

#: Parts of each arm; 1 if not here.
PARTS = {"base": 2}


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.failures", description=__doc__
    )
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train", help="train arms that were not trained yet, measure")
    training.add_argument("arms", nargs="*", help=f"of {', '.join(ARMS)}; all if none")
    training.add_argument("--runs", type=Path, default=Path("runs/failures"), help="their files")
    commands.add_parser("page", help="write the page from experiments/studies/failures/data")
    arguments = parser.parse_args()
    if arguments.command == "train":
        if unknown := set(arguments.arms) - set(ARMS):
            parser.error(f"no such arm: {', '.join(sorted(unknown))}; there are {', '.join(ARMS)}")
        train_all(arguments.arms or list(ARMS), arguments.runs)
        measure(arguments.runs)
    else:
        from experiments.studies.failures import page

        page.write(measures.load(DATA), DOCS)


def train_all(arms: Sequence[str], runs: Path) -> None:
    """Trains the parts of arms that have no file yet."""
    from mjx_reinforce.console.jax_setup import configure_jax

    configure_jax()
    runs.mkdir(parents=True, exist_ok=True)
    for arm in arms:
        for part in range(PARTS.get(arm, 1)):
            path = _path(runs, arm, part)
            if path.exists():
                continue
            start = time.monotonic()
            run = train(ARMS[arm], range(PART * part, PART * (part + 1)))
            np.savez(path, **run.updates, **{k: getattr(run, k) for k in Measured._fields[1:]})
            failing = int((run.final_return < 950).sum())
            seconds = time.monotonic() - start
            print(f"{arm}: {failing} of {PART} seeds fail, {seconds:.0f} s", flush=True)


def measure(runs: Path) -> None:
    """Writes experiments/studies/failures/data from the files of all arms that are there."""
    parts = {arm: [_path(runs, arm, part) for part in range(PARTS.get(arm, 1))] for arm in ARMS}
    missing = [arm for arm, paths in parts.items() if not all(path.exists() for path in paths)]
    if missing:
        sys.exit(f"not trained yet: {', '.join(missing)}; nothing was written")
    all_runs = {
        arm: measures.joined([_load(path) for path in paths]) for arm, paths in parts.items()
    }
    base = all_runs["base"]
    kept = measures.Kept(
        seeds={arm: measures.outcomes(run) for arm, run in all_runs.items()},
        base=measures.compared(base),
        updates=measures.quartiles(base),
        curves=measures.curves(base),
        falls={arm: measures.falls(run) for arm, run in all_runs.items()},
    )
    measures.save(kept, DATA)


def _path(runs: Path, arm: str, part: int) -> Path:
    return runs / f"{arm}-{part}.npz"


def _load(path: Path) -> Measured:
    arrays = dict(np.load(path))
    ends = [arrays.pop(name) for name in Measured._fields[1:]]
    return Measured(arrays, *ends)


if __name__ == "__main__":
    main()
