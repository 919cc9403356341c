"""The command line ``python -m mjx_reinforce.sweep``, from its arguments to its exit status."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.console.commands import command
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.streams import accept_everything, silence_alarms
from mjx_reinforce.runs.command_line import read_groups, refuse, refuse_full, start
from mjx_reinforce.settings.config import Config, changed, check_named
from mjx_reinforce.settings.defaults import named_code
from mjx_reinforce.settings.groups import GROUPS
from mjx_reinforce.sweeps.design import Design, SweepSettings, read_design, read_over
from mjx_reinforce.sweeps.perform import perform

_ABOUT_SWEEPS = (
    "Train many configurations, many seeds of each, side by side. Leaves sweep.json, results.csv "
    "(a row for each configuration and seed), curves.npz, report.html and policies/ (those of the "
    "best and the worst seed of each configuration) in the output directory. "
    "All settings of python -m mjx_reinforce.train may be given, with its presets, and most may be "
    "swept. Seed 3 of a configuration is seed 3 of train with these settings, up to rounding."
)

#: What --help alone shows.
_MAIN = (
    *("over", "chunk_runs", "exact"),
    *("env", "env_steps", "num_seeds", "output", "resume"),
)


def parse_design(arguments: Sequence[str]) -> Design:
    """Returns the sweep that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: see ``runs.command_line.parse`` and ``design.read_over``.
    """
    default, flags, prog = start(arguments, command("sweep"))
    base, settings = _read_flags(flags, default, prog)
    if base.resume is not None:
        return _resumed(flags, base.resume, prog)
    over = read_over(settings.pop("over"))
    return Design(base=base, given=changed(base, default), over=over, **settings)


def _read_flags(flags: Sequence[str], default: Config, prog: str) -> tuple[Config, dict[str, Any]]:
    """Returns the settings of the runs, and those of the sweep by name; --help exits."""
    groups = {"sweep": SweepSettings, **GROUPS}
    return read_groups(groups, flags, default, prog, _ABOUT_SWEEPS, _MAIN)


def _resumed(flags: Sequence[str], directory: Path, prog: str) -> Design:
    """Returns the sweep in a directory; raises ValueError if flags would change it."""
    design = read_design(directory)
    base, settings = _read_flags(flags, design.base, prog)
    if dataclasses.replace(base, resume=None) != design.base or settings != vars(SweepSettings()):
        raise ValueError(f"the sweep in {directory} goes on as it is: give --resume alone")
    check_named(vars(base), named_code(flags), directory)
    return dataclasses.replace(design, resume=directory)


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
    try:
        _, ended = perform(parse_design(arguments), interrupt)
    except ValueError as error:
        refuse(str(error))
    except (RuntimeError, OSError) as error:
        refuse_full(error, "this sweep", "a chunk", "--chunk-runs", "go on with --resume")
    return 0 if ended or interrupt.number is None else 128 + interrupt.number
