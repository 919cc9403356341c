"""The command line of ``python -m mjx_reinforce.train``: presets, flags, and runs that go on."""

import dataclasses
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.streams import say_error
from mjx_reinforce.settings.config import (
    Config,
    changed,
    check_named,
    check_read,
    is_read,
    read_seeds,
)
from mjx_reinforce.settings.defaults import flag_value, for_arguments, named_code
from mjx_reinforce.settings.flags import about_word, asks_brief_help, read_command_line
from mjx_reinforce.settings.groups import GROUPS, MAIN, UNUSUAL
from mjx_reinforce.settings.tables import PRESETS
from mjx_reinforce.training import resume

#: What a run leaves in its directory.
_LEFT_BEHIND = (
    "config.json",
    "metrics.csv",
    "returns.npz",
    "summary.json",
    "learning_curve.png",
    "policy/",
    "checkpoint/",
)
_DESCRIPTION = (
    "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. "
    f"Leaves {', '.join(_LEFT_BEHIND)} in the run directory.\n\n"
    "Defaults depend on the task and on the budget: --help shows those of InvertedPendulum-v5, "
    "--help --env ID those of another, for about a minute of training here, and with "
    "--env-steps N those for N env steps."
)


def parse(arguments: Sequence[str]) -> Config:
    """Returns the settings that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: there is no such preset or flag, a value is not of its type, a setting that is
        given would do nothing, or the run to resume is not there, has other settings, was stopped,
        or is of the user's own environment, which is to be named again.
    """
    default, flags, prog = start(arguments, command("train"))
    config = _read_config(flags, default, prog)
    if config.minutes is not None and flag_value(flags, "--env-steps"):
        raise ValueError(
            f"--minutes {config.minutes:g} and --env-steps {config.env_steps} both say when the "
            "run ends; leave one out"
        )
    if config.resume is None:
        return config
    known = resume.read_settings(config.resume)
    asked = _read_config(flags, known, prog)
    resume.check_settings(known, asked)
    if resume.is_done(known, asked):
        print(
            f"{known.resume} is finished; to go on, give a larger --env-steps or --max-updates, or "
            "--minutes"
        )
        sys.exit(0)
    check_named(vars(known), named_code(arguments), config.resume)
    return asked


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


def _read_config(arguments: Sequence[str], default: Config, prog: str) -> Config:
    """Returns the settings that flags ask for, with others as given; --help exits."""
    said = _DESCRIPTION if asks_brief_help(arguments) else f"{_DESCRIPTION}\n\n{_names()}"
    config, _ = read_groups(GROUPS, arguments, default, prog, said, _main_settings(default))
    check_read(config, changed(config, default))
    return config


def _main_settings(default: Config) -> list[str]:
    """Returns what --help alone shows of the settings with these defaults."""
    own = changed(default, Config())
    unusual = [name for cause, shown in UNUSUAL.items() if cause in own for name in shown]
    return [*(name for name in MAIN if is_read(name, default)), *unusual]


def read_groups(
    groups: Mapping[str, type],
    arguments: Sequence[str],
    default: Config,
    prog: str,
    description: str,
    main: Sequence[str],
) -> tuple[Config, dict[str, Any]]:
    """Returns the settings of a run as flags ask for them, and those that are no run's, by name.

    --help exits.

    Args:
      groups: dataclasses under their titles.
      arguments: the flags.
      default: holds for the settings of a run that no flag names.
      prog: the name of the program, for --help.
      description: of the program, for --help.
      main: the settings that --help alone shows.

    Raises:
      ValueError: see ``flags.read_command_line``; or the flags say by --seeds and by --num-seeds
        how many seeds there are.
    """
    known = vars(default)
    forms = [
        (title, group, group(**{f.name: known[f.name] for f in fields(group) if f.name in known}))
        for title, group in groups.items()
    ]
    form = dataclasses.make_dataclass("Arguments", forms, frozen=True)
    parsed = vars(read_command_line(form, arguments, prog, description, main))
    found = {name: x for group in parsed.values() for name, x in vars(group).items()}
    config = Config(**{name: found.pop(name) for name in known})
    if config.seeds is not None:
        if flag_value(arguments, "--num-seeds"):
            raise ValueError(
                f"--seeds {config.seeds} says how many seeds there are: leave --num-seeds out"
            )
        config = dataclasses.replace(config, num_seeds=len(read_seeds(config.seeds)))
    return config, found


def _names() -> str:
    """Returns the presets and the tasks, for --help all."""
    width = max(map(len, PRESETS))
    presets = "\n".join(f"  {name:{width}}  {line}" for name, (line, _) in PRESETS.items())
    return (
        f"Presets, published programs whose settings replace the defaults:\n{presets}\n\n"
        f"Environments: {', '.join(envs.names())}."
    )


def refuse_full(
    error: RuntimeError | OSError, what: str, part: str, flag: str, again: str
) -> NoReturn:
    """Refuses what met a full memory or disk, as ``refuse``; raises any other error again.

    Args:
      error: XLA's where memory is full, or that of a file.
      what: whose files they are.
      part: what has to fit into memory.
      flag: makes that part smaller.
      again: what to do once there is room on the disk.
    """
    if isinstance(error, OSError):
        room = "make room, then" if error.errno else "then"  # W&B's have no number
        message = f"cannot write the files of {what} ({error}); {room} {again}"
        refuse(message, status=1)
    if "RESOURCE_EXHAUSTED" not in str(error):
        raise error
    flags = f"{flag}, --num-episodes, --eval-episodes or --horizon"
    if os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "").lower() in ("false", "0"):
        flags += "; or unset XLA_PYTHON_CLIENT_PREALLOCATE, with which memory is in pieces"
    refuse(f"{part} does not fit into memory ({error}); lower {flags}")


def refuse(message: str, status: int = 2) -> NoReturn:
    """Says in one line what is wrong, and exits."""
    say_error(message)
    sys.exit(status)
