"""The results of every task with its default settings; docs/results.md is what it writes.

Stages, each of which can be run alone, by task (``--tasks``), and again: what is there is kept,
and what was stopped (Ctrl-C, or ``timeout -s INT 570 python ...``) goes on. ``pack`` is for runs on
another machine: what the stages after ``train`` need of them, to be unpacked in DIR here.

    python -m experiments.studies.results train DIR        # DIR/TASK: a run of mjx_reinforce.train
    python -m experiments.studies.results pack DIR FILE    # FILE.tar.gz, of runs that have ended
    python -m experiments.studies.results sensitivity DIR  # DIR/sensitivity/TASK: a sweep
    python -m experiments.studies.results play DIR         # DIR/play/TASK.csv, docs/films
    python -m experiments.studies.results seconds DIR      # reads runs that were given a time
    python -m experiments.studies.results page DIR         # the files in data, docs/results.md
    python -m experiments.studies.results readme           # README.md, its table of results
    python -m experiments.studies.results pretrained DIR   # the package's policies, of all runs
    python -m experiments.studies.results films            # docs/films, of the package's policies

``page`` without DIR writes the page again from the small files in data. The tasks, their budgets,
their seeds and the published figures are the table in tasks.py.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.kit.places import DOCS, ROOT
from experiments.studies.results.tasks import TASKS, Task

#: The small files.
DATA = Path(__file__).parent / "data"


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    train = commands.add_parser("train", help="train every task")
    sensitivity = commands.add_parser("sensitivity", help="move every setting by a factor of 3")
    pack = commands.add_parser("pack", help="one file of what the later stages need of runs")
    play = commands.add_parser("play", help="play the best and median seeds in Gymnasium; films")
    clock = commands.add_parser("seconds", help="keep what runs reached in their seconds")
    clock.add_argument("directory", type=Path, help="of runs of mjx_reinforce.train")
    page = commands.add_parser("page", help="gather what the stages left, and write the page")
    readme = commands.add_parser("readme", help="write the part of README.md on results")
    pretrained = commands.add_parser("pretrained", help="the policies that the package has")
    for command in (train, sensitivity, pack, play, page, pretrained):
        needed = None if command is not page else "?"
        command.add_argument("directory", type=Path, nargs=needed, help="of all stages")
    pack.add_argument("file", type=Path, help="to be written, .tar.gz")
    for command in (train, sensitivity, pack, play):
        command.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    for command in (train, sensitivity):
        command.add_argument("--num-seeds", type=int, help="in place of the table's")
        command.add_argument("--env-steps", type=int, help="of a seed, in place of the table's")
    pretrained.add_argument("--episodes", type=int, default=256, help="that choose, and measure")
    pretrained.add_argument("--folder", type=Path, default=None, help="in place of the package's")
    play.add_argument("--episodes", type=int, default=100, help="of each policy, in both")
    films = commands.add_parser("films", help="of the package's policies, side by side")
    films.add_argument("--arm", type=Path, help="a run directory of my_arm:Arm, for arm.gif")
    for command in (play, page, films, readme):
        command.add_argument("--docs", type=Path, default=DOCS, help="of page and films")
    for command in (clock, page, readme):
        command.add_argument("--results", type=Path, default=DATA, help="of the small files")
    readme.add_argument("--readme", type=Path, default=ROOT / "README.md", help="to be changed")
    arguments = parser.parse_args()
    try:
        sys.exit(_COMMANDS[arguments.command](arguments))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _tasks(arguments: argparse.Namespace) -> Sequence[Task]:
    changes = {"seeds": arguments.num_seeds, "sweep_seeds": arguments.num_seeds}
    changes |= {"env_steps": arguments.env_steps, "sweep_steps": arguments.env_steps}
    given = {name: value for name, value in changes.items() if value is not None}
    return [TASKS[name]._replace(**given) for name in arguments.tasks]


def _train(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import runs

    return runs.train(_tasks(arguments), arguments.directory)


def _sensitivity(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import runs

    return runs.sensitivity(_tasks(arguments), arguments.directory)


def _pack(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import files

    tasks = [TASKS[name] for name in arguments.tasks]
    for name in files.pack(tasks, arguments.directory, arguments.file):
        print(f"packed {name}")
    return 0


def _play(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import play as results_play

    tasks, films = [TASKS[name] for name in arguments.tasks], arguments.docs / "films"
    results_play.play(tasks, arguments.directory, films, arguments.episodes)
    return 0


def _page(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import clock as results_clock
    from experiments.studies.results import files, seconds
    from experiments.studies.results import page as results_page

    if arguments.directory is not None:
        files.gather(TASKS.values(), arguments.directory, arguments.results)
    parts = files.load(TASKS.values(), arguments.results)
    clock = results_clock.sections(arguments.results, arguments.docs)
    filmed = seconds.played(arguments.results)
    results_page.write(parts, arguments.docs, clock, filmed)
    return 0


def _seconds(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import seconds

    for found in seconds.gather(arguments.directory, arguments.results):
        print(found)
    return 0


def _readme(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import readme as results_readme
    from experiments.studies.results import seconds

    groups = seconds.load(arguments.results)
    results_readme.write(groups, arguments.docs, arguments.readme)
    return 0


def _pretrained(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import pretrained as results_pretrained
    from mjx_reinforce.export.run_files import FOLDER

    folder = arguments.folder or FOLDER
    results_pretrained.pack(arguments.directory, folder, arguments.episodes)
    return 0


def _films(arguments: argparse.Namespace) -> int:
    from experiments.studies.results import films as results_films

    results_films.write(arguments.docs / "films", arguments.arm)
    return 0


_COMMANDS = {
    "train": _train,
    "sensitivity": _sensitivity,
    "pack": _pack,
    "play": _play,
    "seconds": _seconds,
    "page": _page,
    "readme": _readme,
    "pretrained": _pretrained,
    "films": _films,
}

if __name__ == "__main__":
    main()
