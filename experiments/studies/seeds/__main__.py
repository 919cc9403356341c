"""What a thousand seeds say of three arguments in the field; docs/seeds.md is its result.

``python -m experiments.studies.seeds train --task CartPole-v1 --output DIR`` trains 36
configurations of 1,024 seeds each; the same command goes on with it if it was stopped. It leaves
DIR/study.npz. ``python -m experiments.studies.seeds page`` writes the tables of docs/seeds.md from
such files in docs/seeds/data, in about a minute and without a GPU.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.kit.markdown import filled
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
    commands.add_parser("page", help="write the tables")
    arguments = parser.parse_args()
    try:
        if arguments.command == "train":
            _train(arguments)
        else:
            write(sorted((DOCS / "seeds" / "data").iterdir()), DOCS / "seeds.md")
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


def write(sources: Sequence[Path], page: Path) -> None:
    """Writes the tables of a page again, between their marks, of what was measured."""
    from experiments.studies.seeds import answers, few, runs, tables

    tasks, measures = [runs.load(source) for source in sources], ("final return", "average return")
    pairs = [few.any_pair(task, measure, few.COUNTS) for measure in measures for task in tasks]
    made = {
        "tasks": lambda: tables.task_table(tasks),
        "effects": lambda: tables.effects_table(tasks, answers.effects(tasks)),
        "few": lambda: tables.few_table(few.few_seeds(tasks, measures, few.COUNTS)),
        "pairs": lambda: tables.pairs_table(pairs),
    }
    page.write_text(filled(page.read_text("utf-8"), made), encoding="utf-8")


if __name__ == "__main__":
    main()
