"""A sweep from Python: ``mjx_reinforce.sweep``."""

import contextlib
import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.checks import check_kind
from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.perform import perform
from mjx_reinforce.sweeps.reading import SweepResults, read_results


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
