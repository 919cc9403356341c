"""The part of README.md on results: every number of it follows from the small files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from experiments.kit.markdown import filled, fixed, table
from experiments.studies.results import seconds as kept
from experiments.studies.results.clock import is_gpu
from experiments.studies.results.tables import seconds

#: The tasks of the table.
_TASKS = ("Hopper-v5", "HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5", "Swimmer-v5")


def write(groups: Sequence[kept.Group], docs: Path, readme: Path) -> None:
    """Writes the table again, between ``<!-- results -->`` and ``<!-- end -->``.

    Args:
      groups: what is kept of runs that had a time.
      docs: the folder of published.csv.
      readme: the file.
    """
    text = filled(readme.read_text("utf-8"), {"results": lambda: part(groups, docs)})
    readme.write_text(text, encoding="utf-8")


def part(groups: Sequence[kept.Group], docs: Path) -> str:
    """Returns the table; of several CPUs the one with the most runs counts."""
    rows = []
    for task in _TASKS:
        mine = [group for group in groups if group.task == task]
        gpu = [group for group in mine if is_gpu(group.device)]
        cpu = sorted(
            (group for group in mine if not is_gpu(group.device)), key=lambda x: len(x.final)
        )
        cells = [_mean(cpu[-1].minute, np.median) if cpu else "", "", "", ""]
        if gpu:
            cells[1] = _mean(gpu[0].minute)
            cells[2] = f"{_mean(gpu[0].final)} in {seconds(gpu[0].seconds)}"
        if figure := kept.published(docs / "published.csv", task, "PPO"):
            cells[3] = _mean(np.array([figure.mean]))
        rows.append([task, *cells])
    header = ["task", "two cores, a minute", "one H100, a minute", "one H100, at the end", "PPO"]
    return table(header, rows)


def _mean(returns: np.ndarray, of: Callable = np.mean) -> str:
    x = float(of(returns))
    return fixed(x, 1 if abs(x) < 100 else 0)
