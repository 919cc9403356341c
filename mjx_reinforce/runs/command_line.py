"""The command lines that train: presets, flags, what goes on, and what ends in a line."""

import dataclasses
import gc
import shlex
import sys
import traceback
from collections.abc import Sequence
from dataclasses import fields
from typing import NoReturn

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.streams import accept_everything, say_error, silence_alarms
from mjx_reinforce.export.run_files import run_hint
from mjx_reinforce.files import FULL_ERRORS, MovedError, expanded
from mjx_reinforce.runs.design import Design, SweepSettings, check_swept, read_design, read_over
from mjx_reinforce.runs.perform import perform, report_on
from mjx_reinforce.settings.config import (
    CODE,
    Config,
    check_named,
    code_flags,
    is_own,
    read_seeds,
)
from mjx_reinforce.settings.defaults import PRESETS, flag_value, for_arguments, named_code
from mjx_reinforce.settings.flags import about_word, cannot_load, read_command_line
from mjx_reinforce.settings.groups import GROUPS
from mjx_reinforce.training import resume

_TRAIN = (
    "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. Writes "
    "config.json, metrics.csv, returns.npz, summary.json, learning_curve.png, policy/, checkpoint/ "
    "into the run directory.\n\n"
    "Defaults depend on the task and on the budget. --help shows those of InvertedPendulum-v5. "
    "--help --env ID shows those of another task, which most train for a minute, and with "
    "--env-steps N those for N env steps."
)
_SWEEP = (
    "Train many configurations, many seeds of each, side by side. Writes sweep.json, curves.npz, "
    "report.html, report/results.csv (a row for each configuration and seed) and policies/ (the "
    "best and the worst seed of each configuration) into the output directory. Takes all settings "
    "and presets of python -m mjx_reinforce.train; most settings can be swept. Seed 3 of a "
    "configuration is seed 3 of train with these settings, up to rounding."
)
#: Command -> (its description, its settings: dataclasses under their titles).
_COMMANDS: dict[str, tuple[str, dict[str, type]]] = {
    "train": (_TRAIN, GROUPS),
    "sweep": (_SWEEP, {"sweep": SweepSettings, **GROUPS}),
}


def parse(arguments: Sequence[str], name: str = "train") -> Design:
    """Returns the run or the sweep that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.
      name: of the command, "train" or "sweep".

    Raises:
      ValueError: there is no such preset or flag, a value is not of its type, see ``read_over``;
        or what is to go on is not there, has other settings, was stopped, or is of the user's own
        code, which is to be named again.
    """
    default, flags, prog = start(arguments, command(name), timed=name == "train")
    base, sweep = _read(name, flags, default, prog)
    if base.minutes is not None and flag_value(flags, "--env-steps"):
        raise ValueError(
            f"--minutes {base.minutes:g} and --env-steps {base.env_steps} both say when the "
            "run ends; leave one out"
        )
    if base.resume is None:
        swept = read_over(sweep.over)
        if name == "sweep":
            check_swept(swept)
        return Design(
            base=base,
            default=default,
            over=swept,
            exact=sweep.exact,
            chunk_runs=sweep.chunk_runs,
            until_decided=sweep.until_decided,
        )
    directory = base.resume
    design = read_design(directory)
    # The flags are read again, now with the saved settings as defaults: a setting that no flag
    # names must stay as it is, and the comparison below sees only what the user changes.
    base, sweep = _read(name, flags, design.base, prog)
    swept = read_over(sweep.over)
    # A sweep may be named by its --over again, which is how its user confirms code of their own.
    is_unchanged = swept in ({}, design.over) and sweep == SweepSettings(over=sweep.over)
    if not is_unchanged or (design.is_sweep and base != design.base):
        raise ValueError(f"what is in {directory} goes on as it is: give --resume alone")
    if not swept and any(is_own(x) for name in CODE for x in design.over.get(name, ())):
        raise ValueError(
            f"{directory} compares code of your own, and this would run that code; if you trust "
            "it, repeat the sweep's --over"
        )
    resume.check_settings(design.base, base)
    # A finished sweep may still lack its report, so ``perform`` is to look at that.
    if not design.is_sweep and resume.is_done(design.base, base):
        print(
            f"{directory} is finished; to go on, give a larger --env-steps or --max-updates, or "
            "--minutes"
        )
        sys.exit(0)
    check_named(vars(design.base), named_code(arguments), directory)
    return dataclasses.replace(design, base=base, default=design.base)


def start(
    arguments: Sequence[str], prog: str, *, timed: bool = False
) -> tuple[Config, Sequence[str], str]:
    """Reads the preset of a command line.

    Args:
      arguments: a preset's name, if any, then flags.
      prog: the name of the program, for --help.
      timed: see ``defaults.for_arguments``.

    Returns:
      The default settings, the flags, and the program with its preset.

    Raises:
      ValueError: there is no such preset, or it stands beside a run that has all settings.
    """
    if not arguments or arguments[0].startswith("-"):
        return _default(arguments, timed=timed), arguments, f"{prog} [PRESET]"
    preset, *flags = arguments
    if preset not in PRESETS:
        raise ValueError(about_word(preset))
    for name in ("--resume", "--like"):
        if flag_value(flags, name):
            raise ValueError(f"{name} has settings of its own: leave the preset {preset} out")
    return PRESETS[preset][1], flags, f"{prog} {preset}"


def _default(arguments: Sequence[str], *, timed: bool) -> Config:
    """Returns the settings that hold where the user gives none: a task's, or those of a run."""
    if not (like := flag_value(arguments, "--like")):
        return for_arguments(arguments, timed=timed)
    directory = expanded(like)
    if not (directory / "config.json").is_file():
        raise ValueError(f"--like {like}: there is no run (no config.json){run_hint(directory)}")
    config = read_design(directory).base
    check_named(vars(config), named_code(arguments), directory)
    # ``read_design`` prepares for going on in that directory; this run only takes its settings.
    return dataclasses.replace(config, resume=None)


def _read(
    name: str, arguments: Sequence[str], default: Config, prog: str
) -> tuple[Config, SweepSettings]:
    """Returns the settings of a run, and those of a sweep, as flags ask for them.

    --help exits.

    Args:
      name: of the command.
      arguments: the flags.
      default: holds for the settings of a run that no flag names.
      prog: the name of the program, for --help.

    Raises:
      ValueError: see ``flags.read_command_line``; or the flags say by --seeds and by --num-seeds
        how many seeds there are.
    """
    about, groups = _COMMANDS[name]
    default_values = vars(default)
    # A dataclass of dataclasses, one a group, whose titles become the headings of --help. The
    # fields of ``SweepSettings`` are not in a ``Config`` and keep their own defaults.
    group_fields = []
    for title, group in groups.items():
        names = [field.name for field in fields(group) if field.name in default_values]
        group_fields.append((title, group, group(**{name: default_values[name] for name in names})))
    arguments_class = dataclasses.make_dataclass("Arguments", group_fields, frozen=True)
    setting_groups = vars(
        read_command_line(arguments_class, arguments, prog, f"{about}\n\n{_names()}")
    )
    values = {name: x for group in setting_groups.values() for name, x in vars(group).items()}
    # What is left over after this are the settings of the sweep, if it is one.
    config = Config(**{name: values.pop(name) for name in default_values})
    if config.seeds is not None:
        if flag_value(arguments, "--num-seeds"):
            raise ValueError(
                f"--seeds {config.seeds} says how many seeds there are: leave --num-seeds out"
            )
        config = dataclasses.replace(config, num_seeds=len(read_seeds(config.seeds)))
    return config, SweepSettings(**values)


def _names() -> str:
    """Returns the presets and the tasks, for --help."""
    width = max(map(len, PRESETS))
    presets = "\n".join(f"  {name:{width}}  {summary}" for name, (summary, _) in PRESETS.items())
    return (
        "Presets, whose settings replace the defaults (all but legged are published programs):\n"
        f"{presets}\n\n"
        f"Environments: {', '.join(envs.names())}."
    )


def train() -> None:
    """Does what ``python -m mjx_reinforce.train`` does."""
    _do("train")


def sweep() -> None:
    """Does what ``python -m mjx_reinforce.sweep`` does."""
    _do("sweep")


def _do(name: str) -> NoReturn:
    """Does what the command line of a command asks for, says what came of it, and exits.

    The status is 0 when done, 1 if files cannot be written or nothing is finite any more, 2 for bad
    input, 130 after Ctrl-C, 143 after SIGTERM and 129 after SIGHUP.

    Args:
      name: of the command, "train" or "sweep".
    """
    accept_everything()
    silence_alarms()
    # Imports and tracing make many objects and little garbage: that saves a second in eight.
    gc.set_threshold(100_000)
    with Interrupt() as interrupt:
        status = _train(name, interrupt)
    sys.exit(status)


def _train(name: str, interrupt: Interrupt) -> int:
    """Returns the exit status of a command line."""
    try:
        design = parse(sys.argv[1:], name)
    except ValueError as error:
        refuse(str(error))
    outcome = None
    try:
        outcome = perform(design, interrupt)
        report_on(outcome)
    except ImportError as error:
        refuse(cannot_load(error))
    except ValueError as error:
        # The innermost frame tells who raised: this package refuses bad input by ValueError, but
        # one from a library, once training began, is a mistake of this program.
        *_, (stack_frame, _) = traceback.walk_tb(error.__traceback__)
        is_own_code = stack_frame.f_globals.get("__name__", "").startswith("mjx_reinforce")
        if outcome is None and interrupt.deferred() and not is_own_code:
            raise
        refuse(str(error))
    except (RuntimeError, MemoryError, OSError) as error:
        _refuse_full(error, design)
    if outcome.summary["status"] != "interrupted" or interrupt.number is None:
        return int(outcome.summary["status"] == "stopped")
    if design.is_sweep:
        # The next group may still compile in a thread, whose end an ordinary exit would await.
        interrupt.leave(128 + interrupt.number)
    return 128 + interrupt.number


def _refuse_full(error: RuntimeError | MemoryError | OSError, design: Design) -> NoReturn:
    """Refuses what met a full memory or disk, also in a compiler; raises any other error again.

    So is refused a directory that is no longer there.
    """
    if isinstance(error, OSError):
        is_missing = isinstance(error, FileNotFoundError) and not design.directory.is_dir()
        if is_missing or isinstance(error, MovedError):
            refuse(str(MovedError(design.directory)), status=1)
        remedy = "try again"
        if any((design.directory / name).exists() for name in resume.FIRST_FILES):
            quoted = shlex.quote(str(design.directory))
            remedy = f"go on with --resume {quoted}{code_flags(vars(design.base))}"
        # Errors of W&B have no number, and there is nothing here to mend.
        if error.errno in FULL_ERRORS:
            advice = "make room, then"
        elif error.errno:
            advice = "mend that, then"
        else:
            advice = "then"
        file_owner = f"the files of this {design.kind}"
        refuse(f"cannot write {file_owner} ({error}); {advice} {remedy}", status=1)
    if "machine code of a step was not compiled" in str(error):  # the words of cpu/waiting.ll
        refuse(str(error), status=1)
    # JAX reports a full device as a RuntimeError with this status in its text.
    if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
        raise error
    if design.is_sweep:
        batch_unit = "a chunk"
        flag = "--chunk-runs"
    else:
        batch_unit = "this run"
        flag = "--num-seeds"
    memory_flags = f"{flag}, --num-episodes, --eval-episodes or --horizon"
    refuse(f"{batch_unit} does not fit into memory ({error}); lower {memory_flags}")


def refuse(message: str, status: int = 2) -> NoReturn:
    """Says in one line what is wrong, and exits."""
    say_error(message)
    sys.exit(status)
