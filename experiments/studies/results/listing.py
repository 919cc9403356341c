"""A table of runs in a folder: what their policies return, and what all of them cost."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.kit.markdown import table
from experiments.studies.results.kept import task_name
from experiments.studies.results.tables import estimate, number, seconds
from mjx_reinforce.files import read_json
from mjx_reinforce.statistics import estimate_mean, worst_if_not_finite


def of_runs(directory: Path) -> str:
    """Returns the table of all runs in a folder, at any depth, that were evaluated.

    Raises:
      ValueError: there is none.
    """
    lines = list(_lines(directory))
    if not lines:
        raise ValueError(f"{directory} has no run; each has a config.json and a summary.json")
    header = ["run", "task", "seeds", "root", "status", "mean (95%)", "worst", "best"]
    header += ["last evaluation: mean, worst", "seconds, all seeds", "compiling"]
    return table([*header, "env steps per seed", "commit", "on"], lines)


def _lines(directory: Path) -> Iterator[list[str]]:
    for path in sorted(directory.rglob("summary.json")):
        run = path.parent
        if not (run / "config.json").exists():
            continue
        config, summary = read_json(run / "config.json"), read_json(path)
        last = np.array(summary["final_returns"], float)
        # Of a run that was stopped, the last evaluation stands for the test that it has not had.
        tested = np.array(summary.get("final_test_returns", last), float)
        status = summary["status"]
        if "final_test_returns" not in summary:
            status += ", not tested"
        yield [
            str(run.relative_to(directory)),
            task_name(config),
            str(len(tested)),
            str(config["seed"]),
            status,
            estimate(estimate_mean(worst_if_not_finite(tested))),
            *map(number, (tested.min(), tested.max())),
            f"{number(last.mean())}, {number(last.min())}",
            seconds(summary["run_seconds"]),
            seconds(summary["compile_seconds"]),
            f"{np.mean(summary['env_steps']):,.0f}",
            (config.get("git_commit") or "unknown")[:8],
            config["device"],
        ]
