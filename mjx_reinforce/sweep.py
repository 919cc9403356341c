"""``python -m mjx_reinforce.sweep`` trains configurations, many seeds of each, side by side."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import dataclasses
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.runs.alarms import silence_alarms
from mjx_reinforce.runs.command_line import refuse
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.files import remove_empty
from mjx_reinforce.runs.interrupt import Interrupt
from mjx_reinforce.runs.streams import accept_everything
from mjx_reinforce.sweeps.command_line import parse
from mjx_reinforce.sweeps.design import Design
from mjx_reinforce.sweeps.perform import perform
from mjx_reinforce.sweeps.reading import Results, read_results


def main() -> None:
    """Reads the command line, sweeps, and exits, with the statuses of ``train.main``."""
    accept_everything()
    silence_alarms()
    with Interrupt() as interrupt:
        status = _main(sys.argv[1:], interrupt)
        if interrupt.number is not None:  # not at the end of a compiler's thread
            sys.stdout.flush()
            os._exit(status)
    sys.exit(status)


def _main(arguments: Sequence[str], interrupt: Interrupt) -> int:
    """Returns the exit status of a command line."""
    made: list[Path] = []
    interrupt.on_exit(lambda: remove_empty(made))
    try:
        _, ended = perform(parse(arguments), interrupt, made)
    except ValueError as error:
        refuse(str(error), made)
    except RuntimeError as error:  # XLA's
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        remedy = "lower --chunk-runs, --num-episodes, --eval-episodes or --horizon"
        refuse(f"a chunk does not fit into memory ({error}); {remedy}", made)
    except OSError as error:
        remedy = "make room, then go on with --resume"
        refuse(f"cannot write the files of this sweep ({error}); {remedy}", made, status=1)
    return 0 if ended or interrupt.number is None else 128 + interrupt.number


def sweep(
    base: Config,
    over: Mapping[str, Sequence[Any]],
    *,
    output: Path | str | None = None,
    exact: bool = False,
    chunk_runs: int | None = None,
    report: bool = True,
) -> Results:
    """Trains many configurations, ``base.num_seeds`` of each, as the command line does.

    Args:
      base: the settings that are not swept, such as ``defaults.of_task("InvertedPendulum-v5")``.
      over: names of settings and the values of each; all combinations are trained.
      output: the directory of the results; ``runs/<env>-<time>`` if not given.
      exact: move every run by itself, so that no result depends in any bit on the others.
      chunk_runs: runs that are under way at once at most; as many as memory holds by default.
      report: write report.html; ``mjx_reinforce.report`` can do so later.

    Returns:
      What was measured; the same is in the files of the directory.

    Raises:
      ValueError: a setting makes no sense, or the directory is not empty.
    """
    directory = None if output is None else Path(output)
    base = dataclasses.replace(base, output=directory)
    design = Design(base=base, over=over, exact=exact, chunk_runs=chunk_runs)
    directory, _ = perform(design, None, [], report=report)
    return read_results(directory)


if __name__ == "__main__":
    main()
