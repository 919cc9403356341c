"""The command lines that train: presets, flags, what goes on, and what ends in a line."""

import dataclasses
import gc
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.streams import accept_everything, say_error, silence_alarms
from mjx_reinforce.runs.design import Design, SweepSettings, check_swept, read_design, read_over
from mjx_reinforce.runs.directory import choose_directory
from mjx_reinforce.settings.config import (
    Config,
    changed,
    check_named,
    check_read,
    code_flags,
    is_read,
    read_seeds,
)
from mjx_reinforce.settings.defaults import flag_value, for_arguments, named_code
from mjx_reinforce.settings.flags import about_word, asks_brief_help, cannot_load, read_command_line
from mjx_reinforce.settings.groups import GROUPS, MAIN, UNUSUAL
from mjx_reinforce.settings.tables import PRESETS
from mjx_reinforce.training import resume

if TYPE_CHECKING:
    from mjx_reinforce.runs.perform import Outcome


class _Program(NamedTuple):
    """A command that trains.

    about: its description
    groups: its settings, dataclasses under their titles
    main: those that --help alone shows, beside a run's own
    """

    about: str
    groups: Mapping[str, type]
    main: Sequence[str] = ()


_TRAIN = _Program(
    "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. Writes "
    "config.json, metrics.csv, returns.npz, summary.json, learning_curve.png, policy/, checkpoint/ "
    "into the run directory.\n\n"
    "Defaults depend on the task and on the budget. --help shows those of InvertedPendulum-v5 for "
    "about a minute of training on this machine. --help --env ID shows those of another task, and "
    "with --env-steps N those for N env steps.",
    GROUPS,
)
_SWEEP = _Program(
    "Train many configurations, many seeds of each, side by side. Writes sweep.json, curves.npz, "
    "report.html, report/results.csv (a row for each configuration and seed) and policies/ (the "
    "best and the worst seed of each configuration) into the output directory. Takes all settings "
    "and presets of python -m mjx_reinforce.train; most settings can be swept. Seed 3 of a "
    "configuration is seed 3 of train with these settings, up to rounding.",
    {"sweep": SweepSettings, **GROUPS},
    ("over", "chunk_runs", "exact", "env", "env_steps", "num_seeds", "output", "resume"),
)


def parse(arguments: Sequence[str]) -> Design:
    """Returns the run that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: there is no such preset or flag, a value is not of its type, a setting that is
        given would do nothing, or the run to resume is not there, has other settings, was stopped,
        or is of the user's own environment, which is to be named again.
    """
    default, flags, prog = start(arguments, command("train"))
    config, _ = _read(_TRAIN, flags, default, prog)
    if config.minutes is not None and flag_value(flags, "--env-steps"):
        raise ValueError(
            f"--minutes {config.minutes:g} and --env-steps {config.env_steps} both say when the "
            "run ends; leave one out"
        )
    if (resumed := config.resume) is None:
        check_read(config, changed(config, default))
        return Design(base=config, default=default)
    known = resume.read_settings(resumed)
    config, _ = _read(_TRAIN, flags, known, prog)
    check_read(config, changed(config, known))
    resume.check_settings(known, config)
    if resume.is_done(known, config):
        print(
            f"{resumed} is finished; to go on, give a larger --env-steps or --max-updates, or "
            "--minutes"
        )
        sys.exit(0)
    check_named(vars(known), named_code(arguments), resumed)
    return Design(base=config)


def parse_sweep(arguments: Sequence[str]) -> Design:
    """Returns the sweep that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: see ``parse`` and ``read_over``; or flags would change a sweep that goes on.
    """
    default, flags, prog = start(arguments, command("sweep"))
    base, settings = _read(_SWEEP, flags, default, prog)
    if base.resume is None:
        over = read_over(settings.pop("over"))
        check_swept(over)
        return Design(base=base, default=default, over=over, **settings)
    known = read_design(base.resume)
    if _read(_SWEEP, flags, known.base, prog) != (known.base, vars(SweepSettings())):
        raise ValueError(f"the sweep in {base.resume} goes on as it is: give --resume alone")
    check_named(vars(known.base), named_code(flags), base.resume)
    return known


def start(arguments: Sequence[str], prog: str) -> tuple[Config, Sequence[str], str]:
    """Reads the preset of a command line.

    Args:
      arguments: a preset's name, if any, then flags.
      prog: the name of the program, for --help.

    Returns:
      The default settings, the flags, and the program with its preset.

    Raises:
      ValueError: there is no such preset, or it stands beside a run that has all settings.
    """
    if not arguments or arguments[0].startswith("-"):
        return _default(arguments), arguments, f"{prog} [PRESET]"
    preset, *flags = arguments
    if preset not in PRESETS:
        raise ValueError(about_word(preset))
    for name in ("--resume", "--like"):
        if flag_value(flags, name):
            raise ValueError(f"{name} has settings of its own: leave the preset {preset} out")
    return PRESETS[preset][1], flags, f"{prog} {preset}"


def _default(arguments: Sequence[str]) -> Config:
    """Returns the settings that hold where the user gives none: a task's, or those of a run."""
    if not (like := flag_value(arguments, "--like")):
        return for_arguments(arguments)
    if not (Path(like) / "config.json").is_file():
        raise ValueError(f"--like {like}: there is no run, for it has no config.json")
    known = resume.read_settings(Path(like))
    check_named(vars(known), named_code(arguments), Path(like))
    return dataclasses.replace(known, resume=None)


def _read(
    program: _Program, arguments: Sequence[str], default: Config, prog: str
) -> tuple[Config, dict[str, Any]]:
    """Returns the settings of a run as flags ask for them, and those that are no run's, by name.

    --help exits.

    Args:
      program: the command.
      arguments: the flags.
      default: holds for the settings of a run that no flag names.
      prog: the name of the program, for --help.

    Raises:
      ValueError: see ``flags.read_command_line``; or the flags say by --seeds and by --num-seeds
        how many seeds there are.
    """
    known = vars(default)
    forms = [
        (title, group, group(**{f.name: known[f.name] for f in fields(group) if f.name in known}))
        for title, group in program.groups.items()
    ]
    form = dataclasses.make_dataclass("Arguments", forms, frozen=True)
    about, main = program.about, program.main or _main_settings(default)
    if not asks_brief_help(arguments):
        about = f"{about}\n\n{_names()}"
    parsed = vars(read_command_line(form, arguments, prog, about, main))
    found = {name: x for group in parsed.values() for name, x in vars(group).items()}
    config = Config(**{name: found.pop(name) for name in known})
    if config.seeds is not None:
        if flag_value(arguments, "--num-seeds"):
            raise ValueError(
                f"--seeds {config.seeds} says how many seeds there are: leave --num-seeds out"
            )
        config = dataclasses.replace(config, num_seeds=len(read_seeds(config.seeds)))
    return config, found


def _main_settings(default: Config) -> list[str]:
    """Returns what --help alone shows of the settings with these defaults."""
    own = changed(default, Config())
    unusual = [name for cause, shown in UNUSUAL.items() if cause in own for name in shown]
    return [*(name for name in MAIN if is_read(name, default)), *unusual]


def _names() -> str:
    """Returns the presets and the tasks, for --help all."""
    width = max(map(len, PRESETS))
    presets = "\n".join(f"  {name:{width}}  {line}" for name, (line, _) in PRESETS.items())
    return (
        f"Presets, published programs whose settings replace the defaults:\n{presets}\n\n"
        f"Environments: {', '.join(envs.names())}."
    )


def train_to_the_end(
    read: Callable[[Sequence[str]], Design], end: Callable[["Outcome"], object]
) -> NoReturn:
    """Does what a command line asks for, and exits.

    The status is 0 when done, 1 if files cannot be written or nothing is finite any more, 2 for bad
    input, 130 after Ctrl-C and 143 after SIGTERM.

    Args:
      read: the words of the command line -> what it asks for.
      end: says what came of it.
    """
    accept_everything()
    silence_alarms()
    with Interrupt() as interrupt:
        # Imports and tracing make many objects and no garbage: that saves a second in eight.
        gc.disable()
        try:
            status = _train(read, end, interrupt)
        finally:
            gc.enable()
    sys.exit(status)


def _train(
    read: Callable[[Sequence[str]], Design],
    end: Callable[["Outcome"], object],
    interrupt: Interrupt,
) -> int:
    """Returns the exit status of a command line."""
    try:
        design = _in_a_directory(read(sys.argv[1:]))
        from mjx_reinforce.runs.perform import perform
    except ValueError as error:
        refuse(str(error))
    try:
        outcome = perform(design, interrupt, compiled=_collect_again)
        end(outcome)
    except ValueError as error:
        refuse(str(error))
    except (ImportError, MemoryError) as error:
        refuse(cannot_load(error))
    except (RuntimeError, OSError) as error:
        _refuse_full(error, design)
    if outcome.summary["status"] != "interrupted" or interrupt.number is None:
        return int(outcome.summary["status"] == "stopped")
    if design.over:  # not at the end of a compiler's thread
        interrupt.leave(128 + interrupt.number)
    return 128 + interrupt.number


def _in_a_directory(design: Design) -> Design:
    """Returns a design that says where its directory is."""
    base = design.base
    if base.resume is None:
        base = dataclasses.replace(base, output=choose_directory(base.output, base.env))
    return dataclasses.replace(design, base=base)


def _collect_again() -> None:
    """Starts the garbage collector, which never looks again at the objects that are there."""
    gc.freeze()
    gc.enable()


def _refuse_full(error: RuntimeError | OSError, design: Design) -> NoReturn:
    """Refuses what met a full memory or disk, as ``refuse``; raises any other error again."""
    if isinstance(error, OSError):
        directory, what = design.resume or design.base.output, "sweep" if design.over else "run"
        again = "try again"
        if directory is not None and (directory / design.first_file).exists():
            again = f"go on with --resume {directory}{code_flags(vars(design.base))}"
        room = "make room, then" if error.errno else "then"  # W&B's have no number
        refuse(f"cannot write the files of this {what} ({error}); {room} {again}", status=1)
    if "RESOURCE_EXHAUSTED" not in str(error):
        raise error
    part, flag = ("a chunk", "--chunk-runs") if design.over else ("this run", "--num-seeds")
    flags = f"{flag}, --num-episodes, --eval-episodes or --horizon"
    if os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "").lower() in ("false", "0"):
        flags += "; or unset XLA_PYTHON_CLIENT_PREALLOCATE, with which memory is in pieces"
    refuse(f"{part} does not fit into memory ({error}); lower {flags}")


def refuse(message: str, status: int = 2) -> NoReturn:
    """Says in one line what is wrong, and exits."""
    say_error(message)
    sys.exit(status)
