"""The command line ``python -m mjx_reinforce.sweep``, from its arguments to its exit status."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.streams import accept_everything, silence_alarms
from mjx_reinforce.runs.command_line import refuse, refuse_full
from mjx_reinforce.runs.directory import remove_empty
from mjx_reinforce.sweeps.command_line import parse_design
from mjx_reinforce.sweeps.perform import perform


def main() -> None:
    """Reads the command line, sweeps, and exits, with the statuses of ``train.main``."""
    accept_everything()
    silence_alarms()
    with Interrupt() as interrupt:
        status = _sweep(sys.argv[1:], interrupt)
        if interrupt.number is not None:  # not at the end of a compiler's thread
            sys.stdout.flush()
            os._exit(status)
    sys.exit(status)


def _sweep(arguments: Sequence[str], interrupt: Interrupt) -> int:
    """Returns the exit status of a command line."""
    made: list[Path] = []
    interrupt.on_exit(lambda: remove_empty(made))
    try:
        _, ended = perform(parse_design(arguments), interrupt, made)
    except ValueError as error:
        refuse(str(error), made)
    except (RuntimeError, OSError) as error:
        again = "go on with --resume"
        refuse_full(error, "this sweep", "a chunk", "--chunk-runs", again, made)
    return 0 if ended or interrupt.number is None else 128 + interrupt.number
