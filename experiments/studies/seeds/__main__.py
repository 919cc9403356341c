"""What a thousand seeds say of three arguments in the field; docs/seeds.md is its result.

``python -m experiments.studies.seeds train --task CartPole-v1 --output DIR`` trains 36
configurations of 1,024 seeds each; the same command goes on with it if it was stopped. It leaves
DIR/study.npz. ``python -m experiments.studies.seeds page [DIR ...]`` writes docs/seeds.md, its
pictures and its tables from such files, one a task, in about a minute and without a GPU.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

from experiments.kit.places import DOCS


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.seeds", description=__doc__
    )
    commands = parser.add_subparsers(dest="command", required=True)
    train = commands.add_parser("train", help="train the runs of one task")
    train.add_argument("--task", required=True, help="environment id, with a reward threshold")
    train.add_argument("--output", type=Path, required=True, help="directory of its files")
    train.add_argument("--num-seeds", type=int, default=1024, help="of each configuration")
    train.add_argument("--env-steps", type=int, help="of a run; the task's default if not given")
    train.add_argument("--horizon", type=int, help="steps of an episode; the task's if not given")
    page = commands.add_parser("page", help="write the page")
    page.add_argument("sources", nargs="*", type=Path, help="of train; docs/seeds/data/* if none")
    page.add_argument("--docs", type=Path, default=DOCS, help="where; docs/ if not given")
    arguments = parser.parse_args()
    try:
        _train(arguments) if arguments.command == "train" else _page(arguments)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _train(arguments: argparse.Namespace) -> None:
    from experiments.studies.seeds import runs

    base = runs.base_settings(arguments.task, arguments.num_seeds)
    given = {"env_steps": arguments.env_steps, "horizon": arguments.horizon}
    base = dataclasses.replace(base, **{k: v for k, v in given.items() if v is not None})
    if not runs.train(base, arguments.output):
        sys.exit(130)


def _page(arguments: argparse.Namespace) -> None:
    from experiments.studies.seeds import findings, runs
    from experiments.studies.seeds import page as seeds_page

    sources = arguments.sources or sorted((DOCS / "seeds" / "data").iterdir())
    found = findings.find([runs.load(source) for source in sources])
    seeds_page.write(found, arguments.docs)


if __name__ == "__main__":
    main()
