"""The directory of a run, what its results depend on, and CSV files."""

import contextlib
import csv
import datetime
import io
import os
import platform
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from mjx_reinforce.export.files import write_bytes

try:
    import fcntl
except ImportError as error:
    raise ImportError(
        "training and reports need Linux or macOS; on Windows, install mjx_reinforce in WSL 2 "
        "(wsl --install)"
    ) from error

#: A disk with less room (bytes) is full: the files of a small run take about as much.
_ROOM = 2**20
_PACKAGES = ("mjx-reinforce", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "optax", "flax")


def choose_directory(output: Path | None, env: str) -> Path:
    """Returns the run directory: ``output``, or ``runs/<env>-<time>`` if it is None."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")[:-3]
    return Path("runs") / f"{env.replace(':', '.')}-{stamp}" if output is None else output


def prepare(directory: Path, overwrite: bool) -> list[Path]:
    """Makes the run directory.

    Args:
      directory: where.
      overwrite: accept a directory that is not empty.

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
        for folder in (*reversed(directory.parents), directory):
            if _make(folder):
                made.insert(0, folder)
        # Where a run was killed as it wrote its first file, nothing was begun.
        names = [path.name for path in directory.iterdir()]
        if any(not name.startswith(".config.json.") for name in names) and not overwrite:
            raise ValueError(
                f"the run directory {directory} is not empty; choose another --output, "
                "or pass --overwrite to replace the run in it"
            )
        _try_to_write(directory)
    except OSError as error:
        remove_empty(made)
        raise ValueError(
            f"cannot write to the run directory {directory} ({error.strerror}); "
            "make room there, or choose another --output"
        ) from error
    return made


def _make(folder: Path) -> bool:
    """Makes a folder if it is not there; returns whether it was made, and by no other process."""
    if folder.is_dir():
        return False
    try:
        folder.mkdir()
    except FileExistsError:
        if not folder.is_dir():
            folder.stat()  # says what is wrong with a link
            raise
        return False
    return True


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


def create_csv(path: Path, columns: Sequence[str]) -> None:
    """Writes a CSV file that has the names of its columns and no rows yet."""
    write_bytes(path, csv_bytes(columns, []))


def csv_bytes(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Returns a whole CSV file: the names of its columns, then its rows."""
    return _lines([dict(zip(columns, columns, strict=True)), *rows], columns)


def append_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Adds rows to a file of ``create_csv``; a row is whole once its line has ended."""
    append(path, _lines(rows, columns))


def append(path: Path, content: bytes) -> None:
    """Adds bytes to a file, in time that does not depend on what it holds.

    Where the disk is full, or Ctrl-C comes in between, the file is left as it was.
    """
    left = memoryview(content)
    with path.open("ab", buffering=0) as file:
        size = file.tell()
        try:
            while left:
                left = left[file.write(left) :]
        except BaseException:
            file.truncate(size)
            raise


def cut(path: Path, length: int) -> None:
    """Cuts a file back to a length in bytes."""
    with path.open("r+b") as file:
        file.truncate(length)


def _lines(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> bytes:
    """Returns rows as the lines of a CSV file."""
    text = io.StringIO(newline="")
    values = ([row.get(name, "") for name in columns] for row in rows)
    csv.writer(text, lineterminator="\n").writerows(values)
    return text.getvalue().encode()


def provenance() -> dict[str, Any]:
    """Returns what a result depends on besides its settings."""
    import jax

    from mjx_reinforce.engines.native import available
    from mjx_reinforce.runs.memory import num_cores

    return {
        "python": platform.python_version(),
        "packages": versions(),
        "git_commit": _git_commit(),
        "device": str(jax.local_devices()[0].device_kind),
        **available.known_by(),
        "num_devices": jax.device_count(),
        "cpu_count": os.cpu_count(),
        # Among so many threads XLA divides sums on a CPU, which decides their rounding.
        "cores": num_cores() if available.platform() == "cpu" else None,
        "x64": jax.numpy.zeros(()).dtype == "float64",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def versions() -> dict[str, str | None]:
    """Returns the versions of the packages that compute."""
    return {name: version(name) for name in _PACKAGES}


def version(package: str) -> str | None:
    """Returns the version of an installed package, None if it is not installed."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def _git_commit() -> str | None:
    """Returns the commit this package runs from, or None outside a checkout."""
    here = Path(__file__).parent
    command = ["git", "-C", str(here), "rev-parse", "HEAD"]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        tracked = subprocess.run(
            ["git", "-C", str(here), "ls-files", "--error-unmatch", Path(__file__).name],
            capture_output=True,
        )
        if tracked.returncode == 0:
            done = subprocess.run(command, capture_output=True, check=True, text=True)
            return done.stdout.strip()
    return None
