"""Going on: what was begun, by which program, and the checkpoints to which it goes back.

A checkpoint is a run between two blocks of updates, a NumPy archive in RUN/checkpoint/. Each is
written in full, under a name that ends in the beginning of its SHA-256: a file that was cut off or
changed is noticed, and the one before it is used. The newest two stay, and the newest one that
is even, for runs whose budget is raised.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.checks import fits
from mjx_reinforce.export.run_files import run_hint
from mjx_reinforce.files import Arrays, check_archive, read_json, write_bytes
from mjx_reinforce.settings.config import Config, check_each, flag, marked
from mjx_reinforce.settings.declare import MAX_COUNT, Mark

#: What may change when a run goes on: when it ends, and how often it is saved.
BUDGETS = marked(Mark.BUDGET)
#: Settings that say where a run is, not what it does.
PLACE_SETTINGS = marked(Mark.PLACE)
#: Entries of config.json on which every number of a run depends, besides its settings.
_DECISIVE_ENTRIES = (
    "packages",
    "git_commit",
    "device",
    "cpu",
    "cores",
    "machine_code",
    "jax_settings",
    "x64",
    "xla_flags",
)
#: Entries that no number depends on.
_OTHER_ENTRIES = ("python", "num_devices", "cpu_count", "resumed", "played_by")
_DEVICES_FLAG = "--xla_force_host_platform_device_count"
_DAMAGE = "damaged, or of another version of the program; resume with the version that wrote it"


#: The first file of a run, and that of a sweep.
FIRST_FILES = ("config.json", "sweep.json")


def read_record(directory: Path) -> dict[str, Any]:
    """Returns what the first file of a run or a sweep says.

    Raises:
      ValueError: it is not there, or it is damaged.
    """
    for name in FIRST_FILES:
        try:
            return read_json(directory / name)
        except ValueError as error:
            # A file that is damaged, or in a folder that may not be entered, is no reason to look
            # for the other one.
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
    remedy = run_hint(directory) or "; put back a copy, or begin anew with --output"
    raise ValueError(f"cannot resume {directory}: there is no {' or '.join(FIRST_FILES)}{remedy}")


def as_config(record: Mapping[str, Any], path: Path) -> Config:
    """Returns the settings that a file recorded, or raises ValueError, which names the file."""
    setting_types = {
        f.name: f.type for f in dataclasses.fields(Config) if f.name not in PLACE_SETTINGS
    }
    recorded_names = record.keys() - {*_DECISIVE_ENTRIES, *_OTHER_ENTRIES, *PLACE_SETTINGS}
    # Neither a setting too many nor one too few: a default of today may not be that of then.
    if mismatched_names := sorted(recorded_names ^ setting_types.keys()):
        raise ValueError(f"{path} has other settings ({mismatched_names[0]}): it is {_DAMAGE}")
    settings: dict[str, Any] = {}
    for name, annotation in setting_types.items():
        value = record[name]
        # JSON has no tuples, and no setting is a list.
        settings[name] = tuple(value) if isinstance(value, list) else value
        if not fits(settings[name], annotation):
            raise ValueError(f"{path} says {name} is {value!r}: it is {_DAMAGE}")
    config = Config(**settings)
    try:
        check_each(config)
    except ValueError as error:  # which is of flags that nobody gave
        raise ValueError(f"{path}: {error}") from error
    return config


def recordable(config: Config) -> dict[str, Any]:
    """Returns the settings as config.json has them, except where the run is."""
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in PLACE_SETTINGS}
    return json.loads(json.dumps(settings))


def decisive(config: Config) -> dict[str, Any]:
    """Returns the settings that a run cannot change when it goes on."""
    return {name: value for name, value in recordable(config).items() if name not in BUDGETS}


def check_settings(recorded: Config, requested: Config) -> None:
    """Raises ValueError if more than the budget of a run is to change.

    Args:
      recorded: the run's settings.
      requested: those that the command line asks for.
    """
    if requested.output is not None:
        raise ValueError("--resume goes on in the run's own directory: leave --output out")
    if requested.like is not None:
        raise ValueError("--resume goes on with the run's own settings: leave --like out")
    for setting in dataclasses.fields(Config):
        recorded_value = getattr(recorded, setting.name)
        requested_value = getattr(requested, setting.name)
        if recorded_value != requested_value and setting.name not in (*BUDGETS, *PLACE_SETTINGS):
            raise ValueError(
                f"{flag(setting.name)} is {recorded_value} in {recorded.resume} and cannot become "
                f"{requested_value}: only its budget may change; leave it out, or start another run"
            )


def is_done(recorded: Config, requested: Config) -> bool:
    """Returns whether a run has finished and is asked for no more than it did.

    Arguments are those of ``check_settings``.

    Raises:
      ValueError: it is asked for no more, and was stopped because nothing was finite any more.
    """
    assert recorded.resume is not None
    # How often a run is saved decides nothing of where it ends.
    budget_names = (name for name in BUDGETS if name != "checkpoint_every")
    if any(getattr(recorded, name) != getattr(requested, name) for name in budget_names):
        return False
    # A run without a summary, or with a damaged one, did not get to its end.
    try:
        summary = read_json(recorded.resume / "summary.json")
    except ValueError:
        return False
    if summary.get("status") == "stopped":
        raise ValueError(
            f"{recorded.resume} was stopped and would be again: {summary.get('reason')}"
        )
    return summary.get("status") == "finished"


def check_same_program(
    directory: Path, record: Mapping[str, Any], present_record: Mapping[str, Any]
) -> None:
    """Raises ValueError if a run or a sweep was begun by a program whose numbers may differ.

    Args:
      directory: of the run, for the message.
      record: what a file in it says of the program that began it.
      present_record: what ``provenance`` returns.
    """
    for name in (name for name in _DECISIVE_ENTRIES if name in present_record):
        old_entry = record.get(name)
        new_entry = present_record[name]
        if name == "xla_flags":
            old_entry = _without_devices(old_entry)
            new_entry = _without_devices(new_entry)
        # Of versions and JAX's settings the message names the first one that differs.
        if isinstance(old_entry, dict) and isinstance(new_entry, dict):
            changed_keys = [
                key
                for key in {**old_entry, **new_entry}
                if old_entry.get(key) != new_entry.get(key)
            ]
            if changed_keys:
                name = changed_keys[0]
                old_entry = old_entry.get(name)
                new_entry = new_entry.get(name)
        if old_entry != new_entry:
            raise ValueError(
                f"{directory} was begun with {name} {old_entry}, and here it is {new_entry}, so "
                "its numbers would change; resume where it was begun, or start another run"
            )


def _without_devices(flags: object) -> str:
    """Returns XLA_FLAGS without the number of a CPU's devices, with which a run may go on."""
    words = str(flags or "").split()
    return " ".join(word for word in words if not word.startswith(f"{_DEVICES_FLAG}="))


_NUM_NEWEST = 2
_FILE_NAME = re.compile(r"\d{6,}-(even-)?[0-9a-f]{16}\.npz")


class Checkpoint(NamedTuple):
    """All that a run needs to go on as if it had not stopped.

    layout: of the states, see ``StateRows.layout``
    states: [R, B] of the runs as rows of bytes
    best: [R, B] of a run's best policies; without rows in a sweep's
    record: what ``Record.arrays`` returns
    seconds: wall time since the run began, without that of compiling
    metrics_bytes: length of metrics.csv
    env_steps: the budget of a seed, or None
    max_updates: the other budget, or None
    number: its place among the run's checkpoints, once it is saved
    settings: of the run, without its budget
    """

    layout: str
    states: np.ndarray
    best: np.ndarray
    record: Arrays
    seconds: float
    metrics_bytes: int
    env_steps: int | None
    max_updates: int | None
    number: int = 0
    settings: dict[str, Any] | None = None

    def is_even(self, eval_every: int) -> bool:
        """Returns whether no budget has stopped a seed yet, nor cut a block short.

        A run with a larger budget passes through the same state.
        """
        updates = self.record["updates"]
        return bool(np.all(updates == updates[0]) and updates[0] % eval_every == 0)


def save(folder: Path, checkpoint: Checkpoint, *, is_even: bool) -> None:
    """Writes a checkpoint beside those that are there, and removes what it makes superfluous.

    Args:
      folder: made if it does not exist.
      checkpoint: what is written.
      is_even: what ``is_even`` says.

    Raises:
      OSError: it cannot be written; those that are there stay.
    """
    folder.mkdir(exist_ok=True)
    archive_bytes = _encode(checkpoint)
    number = max((_number(path) for path in _archives(folder)), default=0) + 1
    name = f"{number:06d}-{'even-' if is_even else ''}{_digest(archive_bytes)}.npz"
    write_bytes(folder / name, archive_bytes)
    # Two, in case the newest one is damaged. The even one is what a larger budget goes on from.
    paths = _archives(folder)
    live_paths = paths[:_NUM_NEWEST] + [path for path in paths if "-even-" in path.name][:1]
    for path in paths:
        if path not in live_paths:
            path.unlink()


def read_checkpoints(folder: Path, say: Callable[[str], None]) -> Iterator[Checkpoint]:
    """Yields the checkpoints of a folder, the newest first, without those that are damaged.

    Args:
      folder: what ``save`` wrote to; it need not exist.
      say: shows a line about each damaged file.

    Raises:
      ValueError: a checkpoint is undamaged, but of another version of the program.
    """
    for path in _archives(folder):
        archive_bytes = _read(path)
        if archive_bytes is None:
            say(f"checkpoint {path.name} is damaged; trying the one before")
        else:
            yield _decode(archive_bytes, path)


def remove_checkpoints(folder: Path, last_number: int = 0) -> None:
    """Removes the checkpoints after a number, leftovers of writing, and a folder left empty."""
    temporary_paths = folder.glob(".*.npz.*")
    later_paths = (path for path in _archives(folder) if _number(path) > last_number)
    for path in [*temporary_paths, *later_paths]:
        path.unlink()
    # A folder with checkpoints in it stays: ``rmdir`` refuses.
    with contextlib.suppress(OSError):
        folder.rmdir()


def _archives(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, the newest first."""
    paths = folder.iterdir() if folder.is_dir() else ()
    archives = [path for path in paths if _FILE_NAME.fullmatch(path.name) and path.is_file()]
    return sorted(archives, key=_number, reverse=True)


def _number(path: Path) -> int:
    return int(path.name.partition("-")[0])


def _digest(archive_bytes: bytes) -> str:
    return hashlib.sha256(archive_bytes).hexdigest()[:16]


def _read(path: Path) -> bytes | None:
    """Returns the contents of a checkpoint, or None if they are not those that were written."""
    try:
        archive_bytes = path.read_bytes()
        check_archive(io.BytesIO(archive_bytes), stored=True)
    except (OSError, ValueError, zipfile.BadZipFile):
        return None
    return archive_bytes if _digest(archive_bytes) == path.stem.rpartition("-")[2] else None


#: The fields that are arrays of their own.
_ROW_FIELDS = ("states", "best")


def _encode(checkpoint: Checkpoint) -> bytes:
    """Returns a NumPy archive: the rows, the record's arrays, and the rest as JSON."""
    json_fields = checkpoint._asdict()
    record = {f"record/{name}": values for name, values in json_fields.pop("record").items()}
    rows = {name: json_fields.pop(name) for name in _ROW_FIELDS}
    del json_fields["number"]  # it is in the file's name
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, rest=np.array(json.dumps(json_fields)), **rows, **record)
    return archive.getvalue()


def _decode(archive_bytes: bytes, path: Path) -> Checkpoint:
    """Reads what ``_encode`` returned; see ``read_checkpoints``."""
    try:
        with np.load(io.BytesIO(archive_bytes), allow_pickle=False) as archive:
            archive_arrays = {name: archive[name] for name in archive.files}
        json_fields = json.loads(str(archive_arrays.pop("rest")))
        rows = {name: archive_arrays.pop(name) for name in _ROW_FIELDS}
        record = {name.removeprefix("record/"): x for name, x in archive_arrays.items()}
        # By these a checkpoint is chosen, before there is a run to compare its arrays with.
        for name in ("env_steps", "updates"):
            record[name].max()
        # Another version's fields are no arguments of this class: TypeError.
        return Checkpoint(record=record, number=_number(path), **rows, **json_fields)
    except (KeyError, TypeError, zipfile.BadZipFile, ValueError) as error:
        raise ValueError(
            f"{path} does not fit this version of the program ({error}); "
            "resume with the version that wrote it"
        ) from error


def check_arrays(checkpoint: Checkpoint, own_checkpoint: Checkpoint) -> None:
    """Raises ValueError for arrays of other shapes or kinds than those that a run saves.

    The digest in a file's name says that it is as it was written, not by whom.

    Args:
      checkpoint: what was read.
      own_checkpoint: of the run that is to go on; its tables may have other rows.
    """
    num_runs = len(own_checkpoint.record["updates"])
    wanted_arrays = _named_arrays(own_checkpoint)
    for name, array in _named_arrays(checkpoint).items():
        if "." in name:  # a column of a table: a number an evaluation or update, or one a run
            table_name = name.partition(".")[0]
            shape = (_num_rows(checkpoint, table_name), *(num_runs,) * (array.ndim > 1))
            wanted_arrays[name] = np.empty(shape, array.dtype)
    for name, wanted_array in wanted_arrays.items():
        array = _named_arrays(checkpoint).get(name)
        if array is None or _form(array) != _form(wanted_array):
            words = "missing" if array is None else f"{array.dtype}{list(array.shape)}"
            raise ValueError(
                f"checkpoint {checkpoint.number} does not fit its run: {name} is {words}, and must "
                f"be {wanted_array.dtype}{list(wanted_array.shape)}; remove it to go on from the "
                "one before"
            )


def _named_arrays(checkpoint: Checkpoint) -> Arrays:
    """Returns the arrays of a checkpoint by their names, without the states'."""
    return {**checkpoint.record, "best": checkpoint.best}


def _num_rows(checkpoint: Checkpoint, table_name: str) -> int:
    """Returns the rows of the first column of a table."""
    columns = (x for name, x in checkpoint.record.items() if name.startswith(f"{table_name}."))
    return len(np.atleast_1d(next(columns)))


def _form(array: np.ndarray) -> tuple[tuple[int, ...], str]:
    """Returns the shape and the kind of an array's numbers; whether of 32 or 64 bits may differ."""
    return array.shape, array.dtype.kind


def newest_checkpoint(config: Config, say: Callable[[str], None]) -> Checkpoint | None:
    """Returns the newest usable checkpoint, or None: then the run starts again.

    It does so where it has no checkpoint yet, or none that a larger budget passes through.

    Args:
      config: its settings, with the budget that it is to have.
      say: shows a line about each file that does not serve.

    Raises:
      ValueError: the budget is smaller than what the run did, config.json was edited, a checkpoint
        is another version's, or there is none for a budget in time. Or none is left of those that
        were there, so that to start again would replace the policies.
    """
    if config.minutes is not None:  # more than any checkpoint has used
        config = dataclasses.replace(config, env_steps=MAX_COUNT)
    directory = config.resume
    assert directory is not None
    metrics_path = directory / "metrics.csv"
    metrics = metrics_path.read_bytes() if metrics_path.is_file() else b""
    settings = decisive(config)
    has_whole = False
    for checkpoint in read_checkpoints(directory / "checkpoint", say):
        # config.json is a file that people edit; a checkpoint is not.
        for name, value in (checkpoint.settings or {}).items():
            if settings.get(name) != value:
                raise ValueError(
                    f"{directory}/config.json says that {name} is {settings.get(name)}, but the "
                    f"run was trained with {value}; put that back, or start another run"
                )
        # Rows are cut off down to a checkpoint's length; rows that are lost cannot come back.
        if not _has_rows(metrics, checkpoint, config.num_seeds):
            say(f"metrics.csv lacks rows of checkpoint {checkpoint.number}; trying the one before")
        elif _serves(checkpoint, config):
            return checkpoint
        else:
            has_whole = True
    if config.minutes is not None:
        raise ValueError(
            f"{directory} has no checkpoint to go on from for {config.minutes:g} min; leave "
            "--minutes out to train it again, or start another run"
        )
    if not has_whole and (directory / "policy").exists():
        raise ValueError(
            f"{directory} has policies, but no whole checkpoint/ and metrics.csv to go on from, "
            "and would train them from the beginning; put those back from a copy, or remove "
            "policy/ and checkpoint/ to begin again"
        )
    return None


def _has_rows(metrics: bytes, checkpoint: Checkpoint, num_seeds: int) -> bool:
    """Returns whether the bytes of metrics.csv begin with the rows that a checkpoint counts on."""
    rows = metrics[: checkpoint.metrics_bytes]
    # One a seed and evaluation, below the header. An editor may have changed the ends of lines.
    num_lines = 1 + num_seeds * _num_rows(checkpoint, "evaluations")
    return len(rows) == checkpoint.metrics_bytes and rows.count(b"\n") == num_lines


def _serves(checkpoint: Checkpoint, config: Config) -> bool:
    """Returns whether a run with this budget passes through a checkpoint.

    One with a budget in time goes on from any: it is no other run's equal.

    Raises:
      ValueError: the budget is smaller than what it has used.
    """
    # A run in time has had several budgets, one after the other.
    if checkpoint.max_updates == config.max_updates and checkpoint.env_steps in (
        config.env_steps,
        *config.budgets[1::2],
    ):
        return True
    for name, budget, minimum in (
        ("env_steps", config.env_steps, checkpoint.record["env_steps"].max()),
        ("max_updates", config.max_updates, checkpoint.record["updates"].max()),
    ):
        if budget is not None and budget < minimum:
            raise ValueError(
                f"{flag(name)} {budget} is less than the {minimum} of the run so far; give at "
                "least that"
            )
    return config.minutes is not None or checkpoint.is_even(config.eval_every)
