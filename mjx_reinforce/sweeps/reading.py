"""What a sweep measured, read from its files."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.files import read_arrays, read_json


class SweepResults(NamedTuple):
    """What a sweep measured, of R runs in E evaluations.

    directory: of its files, None where none were asked for
    configurations: the values of what was swept, in each
    configuration: [R] the number of each run's
    seed: [R]
    eval_return: [E, R] mean return of the policy's mode; NaN where it was not finite
    env_steps: [E, R] trained until then
    """

    directory: Path | None
    configurations: list[dict[str, Any]]
    configuration: np.ndarray
    seed: np.ndarray
    eval_return: np.ndarray
    env_steps: np.ndarray


def read_results(directory: Path) -> SweepResults:
    """Returns what a finished sweep measured, or raises ValueError."""
    record = read_json(directory / "sweep.json")
    if not (directory / "curves.npz").exists():
        raise ValueError(
            f"{directory} has no results yet: the sweep is {record.get('status', 'unfinished')}; "
            f"go on with it by --resume {directory}"
        )
    listed = record["configurations"]
    values = [{k: x for k, x in one.items() if k != "configuration"} for one in listed]
    return SweepResults(directory, values, **read_arrays(directory / "curves.npz"))
