"""The command line of ``python -m mjx_reinforce.train``: presets, flags, and runs that go on."""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import fields

import tyro

from mjx_reinforce import envs
from mjx_reinforce.registry import check_name
from mjx_reinforce.runs import resume
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.defaults import named_task, of_task
from mjx_reinforce.runs.flags import read
from mjx_reinforce.runs.presets import PRESETS
from mjx_reinforce.runs.relevance import check_read
from mjx_reinforce.runs.settings import GROUPS

#: What a run leaves in its directory.
_FILES = (
    "config.json",
    "metrics.csv",
    "returns.npz",
    "summary.json",
    "learning_curve.png",
    "policy/",
    "checkpoint/",
)


def parse(arguments: Sequence[str]) -> Config:
    """Returns the settings that a command line asks for; --help exits.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: there is no such preset or flag, a value is not of its type, a setting that is
        given would do nothing, or the run to resume is not there or has other settings.
    """
    default, preset = of_task(named_task(arguments)), None
    prog = "python -m mjx_reinforce.train"
    if arguments and not arguments[0].startswith("-"):
        preset, *arguments = arguments
        check_name("preset", preset, PRESETS)
        default, prog = PRESETS[preset][1], f"{prog} {preset}"
    else:
        prog = f"{prog} [PRESET]"
    config = _read(arguments, default, prog)
    if config.resume is None:
        return config
    if preset is not None:
        raise ValueError(f"--resume has the run's own settings: leave the preset {preset} out")
    known = resume.read_settings(config.resume)
    asked = _read(arguments, known, prog)
    resume.check_settings(known, asked)
    if resume.is_done(known, asked):
        print(f"{known.resume} is finished; to go on, give a larger --env-steps or --max-updates")
        sys.exit(0)
    return asked


def _read(arguments: Sequence[str], default: Config, prog: str) -> Config:
    """Returns the settings that flags ask for, with others as given; --help exits."""
    groups = [
        (title, group, group(**{f.name: getattr(default, f.name) for f in fields(group)}))
        for title, group in GROUPS.items()
    ]
    form = tyro.conf.OmitArgPrefixes[dataclasses.make_dataclass("Arguments", groups, frozen=True)]
    parsed = read(form, arguments, prog, _description())
    config = Config(
        **{name: x for title in GROUPS for name, x in vars(getattr(parsed, title)).items()}
    )
    check_read(config, default)
    return config


def _description() -> str:
    width = max(map(len, PRESETS))
    presets = "\n".join(f"  {name:{width}}  {line}" for name, (line, _) in PRESETS.items())
    return (
        "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. "
        f"Leaves {', '.join(_FILES)} in the run directory.\n\n"
        "Defaults depend on the task: --help shows those of InvertedPendulum-v5, --help --env ID "
        "those of another.\n\n"
        f"Presets, published programs whose settings replace the defaults:\n{presets}\n\n"
        f"Environments: {', '.join(envs.names())}."
    )
