"""The results of every task with its default settings: the tables of docs/results.md.

Stages, each of which can be run alone, by task (``--tasks``), and again: what is there is kept,
and what was stopped (Ctrl-C, or ``timeout -s INT 570 python ...``) goes on.

    python -m experiments.studies.results train DIR        # DIR/TASK: a run of mjx_reinforce.train
    python -m experiments.studies.results play DIR         # DIR/play/TASK.csv, docs/films
    python -m experiments.studies.results keep DIR         # data, of the runs of train
    python -m experiments.studies.results seconds DIR      # data, of runs that were given a time
    python -m experiments.studies.results runs DIR         # prints a table of all runs there
    python -m experiments.studies.results page             # the tables and the picture, from data
    python -m experiments.studies.results pretrained DIR   # better ones for the package
    python -m experiments.studies.results films            # docs/films, of the package's policies

The tasks, their budgets, their seeds and the published figures are the table in tasks.py.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

from experiments.kit.markdown import filled
from experiments.kit.places import DOCS, ROOT
from experiments.studies.results.tasks import TASKS

#: The small files.
DATA = Path(__file__).parent / "data"


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stages = ("train", "play", "keep", "seconds", "runs", "page", "pretrained", "films")
    parser.add_argument("stage", choices=stages)
    parser.add_argument("directory", type=Path, nargs="?", help="of all stages but page and films")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--episodes", type=int, default=100, help="of each policy that is played")
    parser.add_argument("--arm", type=Path, help="a run directory of my_arm:Arm, for arm.gif")
    arguments = parser.parse_args()
    if arguments.directory is None and arguments.stage not in ("page", "films"):
        parser.error(f"{arguments.stage} needs a directory")
    try:
        sys.exit(_do(arguments))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _do(arguments: argparse.Namespace) -> int:
    tasks, directory = [TASKS[name] for name in arguments.tasks], arguments.directory
    match arguments.stage:
        case "train":
            from experiments.studies.results import runs

            return runs.train(tasks, directory)
        case "play":
            from experiments.studies.results import play

            play.play(tasks, directory, DOCS / "films", arguments.episodes)
        case "keep":
            from experiments.studies.results import kept

            kept.gather_tasks(tasks, directory, DATA)
        case "seconds":
            from experiments.studies.results import kept

            print(*kept.gather_clock(directory, DATA), sep="\n")
        case "runs":
            from experiments.studies.results import listing

            print(listing.of_runs(directory))
        case "page":
            write(DATA, DOCS, ROOT / "README.md")
        case "pretrained":
            from experiments.studies.results import pretrained
            from mjx_reinforce.export.run_files import FOLDER

            pretrained.pack(directory, FOLDER, arguments.episodes)
        case "films":
            from experiments.studies.results import films

            films.write(DOCS / "films", arguments.arm)
    return 0


def write(data: Path, docs: Path, readme: Path) -> None:
    """Writes the tables of results.md and README.md again, between their marks, and the picture."""
    from experiments.studies.results import figures, kept, tables

    groups, results = kept.clock(data), kept.of_tasks(TASKS.values(), data)
    pendulum = [x for x in results if x.task.env == "InvertedPendulum-v5"]
    made = {
        "gpu": partial(tables.gpu, groups, docs),
        "cpu": partial(tables.cpu, groups, docs),
        "play": partial(tables.play, kept.played(data), docs),
        "tasks": partial(tables.of_tasks, results),
        "pendulum": partial(tables.pendulum, pendulum),
        "optimum": partial(tables.distances, kept.optimum(data)),
        "racing": partial(tables.racing, kept.racing(data)),
        "results": partial(tables.readme, groups, docs),
    }
    for page in (docs / "results.md", readme):
        page.write_text(filled(page.read_text("utf-8"), made), encoding="utf-8")
    figures.draw(data, docs, docs / "results" / "seconds.png")


if __name__ == "__main__":
    main()
