"""The directory of a run: made, checked, locked."""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

try:
    import fcntl
except ImportError as error:
    raise ImportError(
        "training and reports need Linux or macOS; on Windows, install mjx_reinforce in WSL 2 "
        "(wsl --install)"
    ) from error

from mjx_reinforce.console.interrupt import Interrupt

#: What a kill leaves of the first file of a run or a sweep, which then was not begun.
_FIRST = (".config.json.", ".sweep.json.")
#: A disk with less room (bytes) is full: the files of a small run take about as much.
_ROOM = 2**20


def _make(directory: Path) -> None:
    """Makes the directory of a run, or raises OSError.

    Raises:
      ValueError: it is not empty, or is in that of another run.
    """
    if (outer := _run_around(directory)) is not None:
        raise ValueError(
            f"the run directory {directory} would be inside the run {outer}; choose another "
            "--output"
        )
    directory.mkdir(parents=True, exist_ok=True)
    # Where a run was killed as it wrote its first file, nothing was begun.
    if any(not path.name.startswith(_FIRST) for path in directory.iterdir()):
        raise ValueError(
            f"the run directory {directory} is not empty; choose another --output, or delete it"
        )


def _run_around(directory: Path) -> Path | None:
    """Returns the run or sweep that a directory is in, if any."""
    for parent in Path(os.path.realpath(directory)).parents:
        run = (parent / "config.json").exists() and (parent / "metrics.csv").exists()
        if run or (parent / "sweep.json").exists():
            return parent
    return None


def _try_to_write(directory: Path) -> None:
    """Writes a file that is gone at once, or raises OSError."""
    with tempfile.TemporaryFile(dir=directory) as file:
        file.write(bytes(_ROOM))


def remove_empty(folders: Sequence[Path]) -> None:
    """Removes those folders, the innermost first, that have nothing in them."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


@contextlib.contextmanager
def own_directory(directory: Path, interrupt: Interrupt, *, resumed: bool) -> Iterator[None]:
    """Makes the directory of a run or sweep, and keeps other processes out of it.

    Folders that were made and stay empty are removed at the end.

    Args:
      directory: of it.
      interrupt: also removes them.
      resumed: whether it goes on there.

    Raises:
      ValueError: it is not empty, is in that of another run, cannot be written, or is another
        process's.
    """
    made: list[Path] = []
    try:
        made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
        if not resumed:
            _make(directory)
        _try_to_write(directory)
    except OSError as error:
        remove_empty(made)
        remedy = "make room there" + ("" if resumed else ", or choose another --output")
        raise ValueError(
            f"cannot write to the run directory {directory} ({error.strerror}); {remedy}"
        ) from error
    with locked(directory):  # a folder in which another trains stays
        interrupt.on_exit(lambda: remove_empty(made))
        try:
            yield
        finally:
            remove_empty(made)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps other processes from training in a directory; also ends with the process.

    Raises:
      ValueError: another one does.
    """
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another process trains in {directory}; wait for its end, or choose another "
                "--output"
            ) from error
        yield
    finally:
        os.close(descriptor)
