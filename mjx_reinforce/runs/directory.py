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


def make_directory(directory: Path) -> list[Path]:
    """Makes the run directory.

    Returns:
      The folders that were made, the innermost first.

    Raises:
      ValueError: it exists and is not empty, is no directory, is in that of another run, or
        cannot be written.
    """
    made: list[Path] = []
    try:
        if (outer := _run_around(directory)) is not None:
            raise ValueError(
                f"the run directory {directory} would be inside the run {outer}; choose another "
                "--output"
            )
        made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
        directory.mkdir(parents=True, exist_ok=True)
        # Where a run was killed as it wrote its first file, nothing was begun.
        names = [path.name for path in directory.iterdir()]
        if any(not name.startswith(_FIRST) for name in names):
            raise ValueError(
                f"the run directory {directory} is not empty; choose another --output, or delete it"
            )
        _try_to_write(directory)
    except OSError as error:
        remove_empty(made)
        raise ValueError(
            f"cannot write to the run directory {directory} ({error.strerror}); "
            "make room there, or choose another --output"
        ) from error
    return made


def _run_around(directory: Path) -> Path | None:
    """Returns the run or sweep that a directory is in, if any."""
    for parent in Path(os.path.realpath(directory)).parents:
        run = (parent / "config.json").exists() and (parent / "metrics.csv").exists()
        if run or (parent / "sweep.json").exists():
            return parent
    return None


def check_writable(directory: Path) -> None:
    """Raises ValueError if the run in a directory cannot go on there."""
    try:
        _try_to_write(directory)
    except OSError as error:
        raise ValueError(
            f"cannot write to the run directory {directory} ({error.strerror}); make room there"
        ) from error


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
      ValueError: see ``make_directory``, ``check_writable`` and ``locked``.
    """
    made: list[Path] = []
    if resumed:
        check_writable(directory)
    else:
        made = make_directory(directory)
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
