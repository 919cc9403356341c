r"""Tasks of MuJoCo Playground's suite, trained for minutes: the tables of docs/playground.md.

    python -m experiments.studies.playground train DIR --minutes 1    # DIR/TASK, DIR/returns
    python -m experiments.studies.playground train DIR --minutes 8    # the same runs go on
    python -m experiments.studies.playground agree DIR                # DIR/agreement.csv
    python -m experiments.studies.playground breaks DIR --episodes 128 \
        --tasks HumanoidRun --seeds 1 3                   # and HumanoidWalk, seed 7
    python -m experiments.studies.playground keep DIR                 # data, of all three
    python -m experiments.studies.playground page                     # the tables, from data

``--minutes`` is for all seeds of a task together, evaluations included; compiling and the test at
the end come on top. Of several GPUs, give each a process of its own (CUDA_VISIBLE_DEVICES) and a
share of the tasks. Tasks follow one another; what is there is kept, and what was stopped (Ctrl-C,
or ``timeout -s INT 570 python ...``) goes on. Programs are kept on disk: a first call for each task
at the same time, into another folder and with ``--minutes 0.005``, compiles on all cores.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

from experiments.kit import rows
from experiments.kit.markdown import filled
from experiments.kit.places import DOCS

DATA = Path(__file__).parent / "data"


def main() -> int:
    """Reads the command line, does what it says, and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.playground",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("stage", choices=("train", "agree", "breaks", "keep", "page"))
    parser.add_argument("directory", type=Path, nargs="?", help="of all stages but page")
    parser.add_argument("--tasks", nargs="+", help="names of the suite; by default the twenty")
    parser.add_argument("--num-seeds", type=int, default=8)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of breaks")
    parser.add_argument("--minutes", type=float, default=1.0, help="of a task, all seeds together")
    parser.add_argument(
        "--episodes", type=int, default=100, help="of each count; in MJX, breaks plays a quarter"
    )
    parser.add_argument("--impl", choices=("jax", "warp"), default="jax", help="of agree")
    arguments = parser.parse_args()
    if arguments.directory is None and arguments.stage != "page":
        parser.error(f"{arguments.stage} needs a directory")
    directory = Path(arguments.directory or "")
    if arguments.stage == "page":
        write(DATA, DOCS / "playground.md")
        return 0
    if arguments.stage == "keep":
        keep(directory, DATA)
        return 0
    from experiments.studies.playground import runs

    tasks = arguments.tasks or runs.TASKS
    if arguments.stage == "train":
        return not runs.train(tasks, directory, arguments.num_seeds, arguments.minutes)
    if arguments.stage == "breaks":
        from experiments.studies.playground import breaks

        breaks.count(tasks, directory, arguments.seeds, arguments.episodes)
        return 0
    from experiments.studies.playground import agreement

    agreement.compare(tasks, directory, arguments.episodes, arguments.impl)
    return 0


def keep(directory: Path, data: Path) -> None:
    """Adds the rows of a directory to the data, in place of those of the same runs and counts."""
    from experiments.studies.playground import tables

    sources = {
        tables.RETURNS: sorted(directory.glob("returns/*.csv")),
        tables.AGREEMENT: sorted(directory.glob("agreement.csv")),
        tables.BREAKS: sorted(directory.glob("breaks.csv")),
    }
    for name, paths in sources.items():
        new = [row for path in paths for row in rows.read(path)]
        keys = {_key(row) for row in new}
        old = rows.read(data / name) if (data / name).exists() else []
        lines = [row for row in old if _key(row) not in keys] + new
        if lines:
            rows.write(data / name, lines)


def _key(row: dict[str, str]) -> tuple[str, ...]:
    """Returns which run or count a row is of; another device replaces what is there."""
    if "model" in row:
        return row["task"], row["seed"], row["model"]
    return row["task"], row.get("minutes", "")


def write(data: Path, page: Path) -> None:
    """Writes the tables of the page again, between their marks."""
    from experiments.studies.playground import tables

    texts = {
        "returns": partial(tables.returns, data),
        "after a minute": partial(tables.after_a_minute, data),
        "agreement": partial(tables.agreement, data),
        "breaks": partial(tables.breaks, data),
        "speeds": partial(tables.speeds, data),
        "settings": partial(tables.settings, data),
    }
    page.write_text(filled(page.read_text("utf-8"), texts), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
