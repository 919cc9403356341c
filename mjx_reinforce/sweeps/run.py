"""A sweep from Python, ``mjx_reinforce.sweep``, and what it measured."""

import contextlib
import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.checks import check_kind
from mjx_reinforce.files import read_arrays, read_json
from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.perform import perform


class SweepResults(NamedTuple):
    """What a sweep measured, of R runs in E evaluations.

    Attributes:
      directory: of its files, None where none were asked for
      configurations: the values of what was swept, in each
      configuration: [R] the number of each run's
      seed: [R]
      eval_return: [E, R] mean return of the policy's mode; NaN where it was not finite
      env_steps: [E, R] trained until then

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """

    directory: Path | None
    configurations: list[dict[str, Any]]
    configuration: np.ndarray
    seed: np.ndarray
    eval_return: np.ndarray
    env_steps: np.ndarray


def sweep(
    base: Config,
    over: Mapping[str, Sequence[Any]],
    *,
    output: Path | str | None = None,
    exact: bool = False,
    chunk_runs: int | None = None,
    report: bool = True,
    quiet: bool = False,
) -> SweepResults:
    """Trains many configurations, ``base.num_seeds`` of each, as the command line does.

    Args:
      base: the settings that are not swept, such as ``mjx_reinforce.of_task("Hopper-v5")``.
      over: names of settings and the values of each; all combinations are trained.
      output: the directory of the sweep's files. None, with ``base.output`` None too, leaves none.
      exact: move every run by itself, so that no result depends in any bit on the others.
      chunk_runs: runs that are under way at once at most; as many as memory holds by default.
      report: write report.html among the files.
      quiet: show no progress.

    Returns:
      What was measured; the same is in the files of the directory.

    Raises:
      ValueError: a setting makes no sense, or the directory is not empty.
      OSError: a file cannot be written.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """
    check_kind("base", base, Config, 'mjx_reinforce.of_task("Hopper-v5")')
    with contextlib.ExitStack() as held:
        asked = base.output if output is None else Path(output)
        place = asked
        if place is None:
            place = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="sweep-")))
        base = dataclasses.replace(base, output=place)
        design = Design(base=base, over=over, exact=exact, chunk_runs=chunk_runs)
        perform(design, None, [], report=report and asked is not None, quiet=quiet)
        return read_results(place)._replace(directory=asked)


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
