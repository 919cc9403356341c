"""Files that are written whole or not at all, and CSV files that grow by whole rows."""

import contextlib
import csv
import errno
import io
import json
import keyword
import os
import secrets
import sys
import tempfile
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from mjx_reinforce.engine.checks import explain
from mjx_reinforce.engine.memory import gigabytes

#: What the system says where no room is left, on the disk or of what this user may have of it.
FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: What arrays may take that are read from an archive (bytes).
_MAX_BYTES = 2**26
#: Or, of a large archive, how often its own size.
_MAX_RATIO = 32
#: Named arrays, as an archive (.npz) holds them.
Arrays = dict[str, np.ndarray]


def expanded(path: str | Path) -> Path:
    """Returns a path with the folder that ``~`` stands for, as a shell reads it."""
    return Path(os.path.expanduser(path))


def write_bytes(path: Path, content: bytes) -> None:
    """Replaces a file at once: a reader, a crash or a power cut sees the old one or the new one."""
    # In the same folder: a file system replaces at once only what is its own.
    temporary_path = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary_path.open("xb") as file:
            file.write(content)
            # Else a power cut could leave the new name with nothing in it.
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary_path, path)
    except BaseException as error:
        with contextlib.suppress(FileNotFoundError):
            temporary_path.unlink()
        # A write to a full disk names no file.
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)
        raise
    with contextlib.suppress(OSError):  # not every file system can; the file is whole without it
        _sync(path.parent)


def remove_leftovers(*folders: Path) -> None:
    """Removes what a crash left of ``write_bytes`` in folders, which need not exist."""
    for folder in folders:
        # Eight hexadecimal digits, as ``write_bytes`` ends the name of a temporary file.
        for temporary_path in folder.glob(".*." + 8 * "[0-9a-f]"):
            temporary_path.unlink()


def check_folder(folder: Path) -> None:
    """Raises ValueError if no file can be made in a folder; /proc says that it could."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        folder_note = "" if folder.exists() else ", which does not exist"
        raise ValueError(
            f"cannot write to {folder}{folder_note}; choose another --output"
        ) from error


class MovedError(FileNotFoundError):
    """A directory was moved or removed while files were written into it."""

    def __init__(self, directory: Path):
        super().__init__(
            f"{directory} was moved or removed before all of its files were written, and no more "
            "are; where it is now, --resume goes on with it"
        )


def check_place(directory: Path, place: os.stat_result) -> None:
    """Raises MovedError if a directory is not the one it was, though another be in its place.

    Args:
      directory: into which files are written.
      place: what ``stat`` said of it.
    """
    try:
        is_same = os.path.samestat(directory.stat(), place)
    except (FileNotFoundError, NotADirectoryError):
        is_same = False
    if not is_same:
        raise MovedError(directory)


def check_output(path: Path, overwrite: bool, *endings: str) -> None:
    """Raises ValueError if a file cannot be written, or would replace one unasked.

    Args:
      path: of the file.
      overwrite: whether it may replace one.
      endings: one of which its name has.
    """
    if path.suffix.lower() not in endings:
        raise ValueError(f"--output must end in {' or '.join(endings)}, got {path}")
    check_folder(path.parent)
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path} exists; pass --overwrite or another --output")


def check_module(path: Path, example: str) -> None:
    """Raises ValueError for a file that Python cannot import, or that hides another module.

    The message has the ``example`` of a better --output.
    """
    name = path.stem
    is_module = path.suffix == ".py" and name.isidentifier() and not keyword.iskeyword(name)
    # Python looks in the folder of a script first: a numpy.py there would be NumPy for all.
    if not is_module or name in {"numpy", *sys.stdlib_module_names}:
        raise ValueError(
            f"Python cannot import {path.name!r} beside its own modules and NumPy; choose an "
            f"--output of letters, digits and underscores, such as {example}"
        )


def check_header(path: Path, example: str) -> None:
    """Raises ValueError for a header whose name does not begin the names of C in it.

    The message has the ``example`` of a better --output.
    """
    name = path.stem
    # C keeps names for itself that begin with an underscore.
    if not (name.isascii() and name.isidentifier()) or name.startswith("_"):
        raise ValueError(
            f"C has no names that begin with {name!r}; choose an --output of letters, digits and "
            f"underscores, such as {example}"
        )


def _sync(folder: Path) -> None:
    """Waits until the names in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Writes JSON; numbers that are not finite become null, which JSON has."""
    text = json.dumps(finite(value), indent=2, default=str, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Returns the JSON object in a file.

    Raises:
      ValueError: it cannot be read, or holds something else.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"cannot read {path} ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        problem = error if path.stat().st_size else "it is empty"
        raise ValueError(f"{path} is damaged: {problem}; put back a copy of it") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} is damaged: it holds no JSON object; put back a copy of it")
    return value


@contextlib.contextmanager
def naming_damage(path: Path) -> Iterator[None]:
    """Names a file in what a block raises that looks for something in its content."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{path} is damaged: {error.args[0]} is missing") from error
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except Exception as error:  # what first meets an entry of another kind has no common class
        raise ValueError(f"{path} is damaged: {explain(error)}") from error


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Writes a NumPy archive (.npz) of named arrays; no pickle."""
    buffer = io.BytesIO()
    save = np.savez_compressed if compressed else np.savez
    save(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_arrays(
    path: Path, names: Collection[str] | None = None, *, stored: bool = False
) -> Arrays:
    """Returns arrays of a NumPy archive by their names; no pickle.

    Args:
      path: of the archive.
      names: of the arrays; no other is read. None for all.
      stored: refuse what is compressed, see ``check_archive``.

    Raises:
      ValueError: it cannot be read, or is damaged; or has no array of a name.
    """
    try:
        with path.open("rb") as file:
            # Before NumPy unpacks anything.
            check_archive(file, names, stored=stored)
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                array_names = archive.files if names is None else [x for x in names if x in archive]
                arrays = {name: np.asarray(archive[name]) for name in array_names}
    except OSError as error:
        raise ValueError(f"cannot read {path} ({error.strerror})") from error
    except Exception as error:  # what zip and NumPy raise has no common class
        # NumPy's second sentence proposes to trust a pickle.
        reason = f"{type(error).__name__}: {error}".splitlines()[0].partition(". ")[0]
        raise ValueError(f"{path} is damaged: not a whole NumPy archive ({reason})") from error
    if missing_names := [name for name in names or () if name not in arrays]:
        raise ValueError(f"{path} is damaged: {missing_names[0]} is missing")
    return arrays


def check_archive(
    archive: IO[bytes], names: Collection[str] | None = None, *, stored: bool = False
) -> None:
    """Raises ValueError for an archive whose few bytes ask for gigabytes; nothing is unpacked.

    Args:
      archive: a file.
      names: of the arrays that are to be read; None for all.
      stored: refuse compressed arrays of any size.
    """
    size = archive.seek(0, os.SEEK_END)
    with zipfile.ZipFile(archive) as zip_file:
        members = zip_file.infolist()
    compressed = [member.filename for member in members if member.compress_type]
    if stored and compressed:
        raise ValueError(f"{compressed[0]!a} is compressed")
    # An array is a member of its name and .npy; sizes are what the archive says of itself, and
    # unpacking ends with an error beyond them.
    if names is not None:
        members = [x for x in members if x.filename.removesuffix(".npy") in names]
    total = sum(member.file_size for member in members)
    if total > max(_MAX_BYTES, _MAX_RATIO * size):
        raise ValueError(
            f"its arrays take {gigabytes(total)}, too many times the {gigabytes(size)} of the file"
        )


def finite(value: object) -> Any:
    """Returns a value for JSON: numbers that are not finite are None."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    # NaN compares as false with every number, so that one comparison finds it, too.
    if isinstance(value, float) and not (-float("inf") < value < float("inf")):
        return None
    return value


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Returns rows as the lines of a CSV file."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def append(path: Path, content: bytes) -> None:
    """Adds bytes to a file, in time that does not depend on what it holds.

    Where the disk is full, or Ctrl-C comes in between, the file is left as it was.

    Raises:
      OSError: it cannot be written, or it is not there, and with it what it held before.
    """
    remaining_bytes = memoryview(content)
    # Unbuffered: a buffer would be written when the file is closed, behind the cut below. Such a
    # write may take a part of the bytes only.
    with path.open("r+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        try:
            while remaining_bytes:
                remaining_bytes = remaining_bytes[file.write(remaining_bytes) :]
        except BaseException:
            file.truncate(size)
            raise


def cut(path: Path, length: int) -> None:
    """Cuts a file back to a length in bytes."""
    with path.open("r+b") as file:
        file.truncate(length)
