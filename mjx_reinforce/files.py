"""Files that are written whole or not at all, and CSV files that grow by whole rows."""

import contextlib
import csv
import io
import json
import math
import os
import secrets
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

#: Named arrays, as an archive (.npz) holds them.
Arrays = dict[str, np.ndarray]

#: Versions of NumPy's format that arrays of numbers and text have, and what reads their headers.
_HEADERS: dict[tuple[int, int], Callable[..., Any]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class Header(NamedTuple):
    """What an archive says of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype


def write_bytes(path: Path, content: bytes) -> None:
    """Replaces a file at once: a reader, a crash or a power cut sees the old one or the new one."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()
        raise
    with contextlib.suppress(OSError):  # not every file system can; the file is whole without it
        _sync(path.parent)


def check_folder(folder: Path) -> None:
    """Raises ValueError if no file can be made in a folder; /proc says that it could."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        missing = "" if folder.exists() else ", which does not exist"
        raise ValueError(f"cannot write to {folder}{missing}; choose another --output") from error


def _sync(folder: Path) -> None:
    """Waits until the names in a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} is damaged: it holds no JSON object")
    return value


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Writes a NumPy archive (.npz) of named arrays; no pickle."""
    content = io.BytesIO()
    save = np.savez_compressed if compressed else np.savez
    save(content, allow_pickle=False, **arrays)
    write_bytes(path, content.getvalue())


def read_arrays(
    path: Path,
    check: Callable[[Mapping[str, Header]], Any] | None = None,
    *,
    stored: bool = False,
) -> Arrays:
    """Returns the arrays of a NumPy archive by their names.

    Args:
      path: of the archive.
      check: raises ValueError for names, shapes or types that the archive must not have; before any
        array is read.
      stored: whether it is known not to be compressed, see ``members``.

    Raises:
      ValueError: it cannot be read, or is damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path} ({error.strerror})") from error
    with _damage_in(path):
        headers = members(content, stored=stored)
    if check is not None:
        check(headers)
    with _damage_in(path), np.load(io.BytesIO(content), allow_pickle=False) as opened:
        return {name: np.asarray(opened[name]) for name in opened.files}


@contextlib.contextmanager
def _damage_in(path: Path) -> Iterator[None]:
    """Raises what zip and NumPy raise, which has no common class, as a ValueError with the name."""
    try:
        yield
    except Exception as error:
        # NumPy's second sentence proposes to trust a pickle.
        reason = f"{type(error).__name__}: {error}".splitlines()[0].partition(". ")[0]
        raise ValueError(f"{path} is damaged: it is no whole NumPy archive ({reason})") from error


def members(content: bytes, *, stored: bool) -> dict[str, Header]:
    """Returns what an archive says of its arrays, by their names; reads none of them.

    Args:
      content: of the archive.
      stored: refuse what is compressed. Arrays then take no more memory than the archive: a few
        compressed bytes can ask for gigabytes.

    Raises:
      ValueError: an array is not as long as it says, is compressed, or is of Python objects.
      Exception: of other kinds, for what is no archive.
    """
    found = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if stored and info.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{name!a} is compressed")
            with archive.open(info) as file:
                read = _HEADERS[np.lib.format.read_magic(file)]
                shape, _, dtype = read(file)
                size = file.tell() + math.prod(shape) * dtype.itemsize
            if size != info.file_size or any(length < 0 for length in shape):
                raise ValueError(f"{name!a} is not as long as it says")
            if dtype.hasobject:
                raise ValueError(f"{name!a} holds Python objects")
            found[name] = Header(shape, dtype)
    return found


def finite(value: object) -> Any:
    """Returns a value for JSON: numbers that are not finite are None."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not (-float("inf") < value < float("inf")):
        return None
    return value


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
