"""Resuming a run: its own settings, the same program, and the newest usable checkpoint."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_reinforce.engine.checks import fits
from mjx_reinforce.files import read_json
from mjx_reinforce.settings.config import Config, flag, marked
from mjx_reinforce.settings.declare import Mark

if TYPE_CHECKING:
    from mjx_reinforce.training.checkpoint import Checkpoint

#: What may change when a run goes on: when it ends, and how often it is saved.
BUDGETS = marked(Mark.BUDGET)
#: Settings that say where a run is, not what it does.
PLACES = marked(Mark.PLACE)
#: Entries of config.json on which every number of a run depends, besides its settings.
_PROGRAM = (
    *("packages", "git_commit", "device", "cpu", "cores", "machine_code", "jax_settings"),
    *("x64", "xla_flags"),
)
#: Entries that no number depends on.
_BESIDE = ("python", "num_devices", "cpu_count", "resumed")
_DEVICES = "--xla_force_host_platform_device_count"
_OTHER = "damaged, or of another version of the program; resume with the version that wrote it"


#: The first file of a run, and that of a sweep.
_BEGUN = ("config.json", "sweep.json")


def read_record(directory: Path) -> dict[str, Any]:
    """Returns what the first file of a run or a sweep says.

    Raises:
      ValueError: it is not there, or it is damaged.
    """
    for name in _BEGUN:
        try:
            return read_json(directory / name)
        except ValueError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
    raise ValueError(
        f"cannot resume {directory}: there is no {' or '.join(_BEGUN)}, so nothing was begun "
        "there; start it anew with --output"
    )


def as_config(recorded: Mapping[str, Any], path: Path) -> Config:
    """Returns the settings that a file recorded, or raises ValueError, which names the file."""
    kinds = {f.name: f.type for f in dataclasses.fields(Config) if f.name not in PLACES}
    if odd := sorted((recorded.keys() - {*_PROGRAM, *_BESIDE, *PLACES}) ^ kinds.keys()):
        raise ValueError(f"{path} has other settings ({odd[0]}): it is {_OTHER}")
    settings: dict[str, Any] = {}
    for name, kind in kinds.items():
        value = recorded[name]
        settings[name] = tuple(value) if isinstance(value, list) else value
        if not fits(settings[name], kind):
            raise ValueError(f"{path} says {name} is {value!r}: it is {_OTHER}")
    return Config(**settings)


def recordable(config: Config) -> dict[str, Any]:
    """Returns the settings as config.json has them, except where the run is."""
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in PLACES}
    return json.loads(json.dumps(settings))


def decisive(config: Config) -> dict[str, Any]:
    """Returns the settings that a run cannot change when it goes on."""
    return {name: value for name, value in recordable(config).items() if name not in BUDGETS}


def check_settings(known: Config, asked: Config) -> None:
    """Raises ValueError if more than the budget of a run is to change.

    Args:
      known: the run's settings.
      asked: those that the command line asks for.
    """
    if asked.output is not None:
        raise ValueError("--resume goes on in the run's own directory: leave --output out")
    if asked.like is not None:
        raise ValueError("--resume goes on with the run's own settings: leave --like out")
    for field in dataclasses.fields(Config):
        old, new = getattr(known, field.name), getattr(asked, field.name)
        if old != new and field.name not in (*BUDGETS, *PLACES):
            raise ValueError(
                f"{flag(field.name)} is {old} in {known.resume} and cannot become {new}: only "
                "its budget may change; leave it out, or start another run"
            )


def is_done(known: Config, asked: Config) -> bool:
    """Returns whether a run has finished and is asked for no more than it did.

    Raises:
      ValueError: it is asked for no more, and was stopped because nothing was finite any more.
    """
    assert known.resume is not None
    ends = (name for name in BUDGETS if name != "checkpoint_every")
    if any(getattr(known, name) != getattr(asked, name) for name in ends):
        return False
    try:
        summary = read_json(known.resume / "summary.json")
    except ValueError:
        return False
    if summary.get("status") == "stopped":
        raise ValueError(f"{known.resume} was stopped and would be again: {summary.get('reason')}")
    return summary.get("status") == "finished"


def check_same_program(
    directory: Path, recorded: Mapping[str, Any], present: Mapping[str, Any]
) -> None:
    """Raises ValueError if a run or a sweep was begun by a program whose numbers may differ.

    Args:
      directory: of the run, for the message.
      recorded: what a file in it says of the program that began it.
      present: what ``provenance`` returns.
    """
    for name in (name for name in _PROGRAM if name in present):
        old, new = recorded.get(name), present[name]
        if name == "xla_flags":
            old, new = _without_devices(old), _without_devices(new)
        if isinstance(old, dict) and isinstance(new, dict):
            changed = [key for key in {**old, **new} if old.get(key) != new.get(key)]
            if changed:
                name, old, new = changed[0], old.get(changed[0]), new.get(changed[0])
        if old != new:
            raise ValueError(
                f"{directory} was begun with {name} {old}, and here it is {new}, so its numbers "
                "would change; resume where it was begun, or start another run"
            )


def _without_devices(flags: object) -> str:
    """Returns XLA_FLAGS without the number of a CPU's devices, with which a run may go on."""
    kept = (x for x in str(flags or "").split() if not x.startswith(f"{_DEVICES}="))
    return " ".join(kept)


def newest_checkpoint(config: Config, say: Callable[[str], None]) -> "Checkpoint | None":
    """Returns the newest usable checkpoint, or None: then the run starts again.

    Args:
      config: its settings, with the budget that it is to have.
      say: shows a line about each file that does not serve.

    Raises:
      ValueError: the budget is smaller than what the run did, config.json was edited, or a
        checkpoint is another version's.
    """
    from mjx_reinforce.training import checkpoint

    assert config.resume is not None
    metrics = config.resume / "metrics.csv"
    length = metrics.stat().st_size if metrics.exists() else 0
    for found in checkpoint.read_checkpoints(config.resume / "checkpoint", say):
        for name, value in (found.settings or {}).items():
            if (said := decisive(config).get(name)) != value:
                raise ValueError(
                    f"{config.resume}/config.json says that {name} is {said}, but the run was "
                    f"trained with {value}; put that back, or start another run"
                )
        if found.metrics_bytes > length:
            say(f"metrics.csv is shorter than at checkpoint {found.number}; trying the one before")
        elif _serves(found, config):
            return found
    return None


def _serves(found: "Checkpoint", config: Config) -> bool:
    """Returns whether a run with this budget passes through a checkpoint.

    One with a budget in time goes on from any: it is no other run's equal.

    Raises:
      ValueError: the budget is smaller than what it has used.
    """
    if (found.env_steps, found.max_updates) == (config.env_steps, config.max_updates):
        return True
    for name, budget, used in (
        ("env_steps", config.env_steps, found.record["env_steps"].max()),
        ("max_updates", config.max_updates, found.record["updates"].max()),
    ):
        if budget is not None and budget < used:
            raise ValueError(
                f"{flag(name)} {budget} is less than the {used} of the run so far; give at least "
                "that"
            )
    return config.minutes is not None or found.is_even(config.eval_every)
