"""Checkpoints: a run between two blocks of updates, as NumPy archives in RUN/checkpoint/.

Each archive is written whole, under a name that ends in the beginning of its SHA-256: a file that
was cut off or changed is noticed, and the one before it is used. The newest two are kept, and the
newest one that is even, for runs whose budget is raised.
"""

import contextlib
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays, check_stored, write_bytes

_KEPT = 2
_NAME = re.compile(r"\d{6,}-(even-)?[0-9a-f]{16}\.npz")


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


def save(folder: Path, checkpoint: Checkpoint, *, even: bool) -> None:
    """Writes a checkpoint beside those that are there, and removes what it makes superfluous.

    Args:
      folder: made if it does not exist.
      checkpoint: what is written.
      even: what ``is_even`` says.

    Raises:
      OSError: it cannot be written; those that are there stay.
    """
    folder.mkdir(exist_ok=True)
    content = _encode(checkpoint)
    number = max((_number(path) for path in _archives(folder)), default=0) + 1
    name = f"{number:06d}-{'even-' if even else ''}{_digest(content)}.npz"
    write_bytes(folder / name, content)
    files = _archives(folder)
    kept = files[:_KEPT] + [path for path in files if "-even-" in path.name][:1]
    for path in files:
        if path not in kept:
            path.unlink()


def read_checkpoints(folder: Path, say: Callable[[str], None]) -> Iterator[Checkpoint]:
    """Yields the checkpoints of a folder, the newest first, without those that are damaged.

    Args:
      folder: what ``save`` wrote to; it need not exist.
      say: shows a line about each damaged file.

    Raises:
      ValueError: a checkpoint is whole, but of another version of the program.
    """
    for path in _archives(folder):
        content = _read(path)
        if content is None:
            say(f"checkpoint {path.name} is damaged; trying the one before")
        else:
            yield _decode(content, path)


def remove_checkpoints(folder: Path, after: int = 0) -> None:
    """Removes the checkpoints after a number, parts of unwritten ones, and a folder left empty."""
    parts = folder.glob(".*.npz.*")
    for path in [*parts, *(path for path in _archives(folder) if _number(path) > after)]:
        path.unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


def _archives(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, the newest first."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return sorted(filter(lambda path: _NAME.fullmatch(path.name), paths), key=_number, reverse=True)


def _number(path: Path) -> int:
    return int(path.name.partition("-")[0])


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _read(path: Path) -> bytes | None:
    """Returns the contents of a checkpoint, or None if they are not those that were written."""
    try:
        content = path.read_bytes()
        check_stored(io.BytesIO(content))
    except (OSError, ValueError, zipfile.BadZipFile):
        return None
    return content if _digest(content) == path.stem.rpartition("-")[2] else None


#: The fields that are arrays of their own.
_ROWS = ("states", "best")


def _encode(checkpoint: Checkpoint) -> bytes:
    """Returns a NumPy archive: the rows, the record's arrays, and the rest as JSON."""
    rest = checkpoint._asdict()
    record = {f"record/{name}": values for name, values in rest.pop("record").items()}
    rows = {name: rest.pop(name) for name in _ROWS}
    del rest["number"]
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, rest=np.array(json.dumps(rest)), **rows, **record)
    return archive.getvalue()


def _decode(content: bytes, path: Path) -> Checkpoint:
    """Reads what ``_encode`` returned; see ``read_checkpoints``."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        rest = json.loads(str(arrays.pop("rest")))
        rows = {name: arrays.pop(name) for name in _ROWS}
        record = {name.removeprefix("record/"): x for name, x in arrays.items()}
        return Checkpoint(record=record, number=_number(path), **rows, **rest)
    except (KeyError, TypeError, zipfile.BadZipFile, ValueError) as error:
        raise ValueError(
            f"{path} does not fit this version of the program ({error}); "
            "resume with the version that wrote it"
        ) from error
