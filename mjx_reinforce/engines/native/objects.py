"""Compiled objects on disk: written whole or not at all, checked when read, bounded in size.

They are code: only what nobody but this user and root may have written is read.
"""

import contextlib
import functools
import hashlib
import os
import tempfile
import warnings
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from mjx_reinforce.engines.native.ownership import distrust, is_trusted, make_folder

if TYPE_CHECKING:
    from importlib.abc import Traversable

#: Where a folder holds more bytes than this, what was used longest ago goes.
LIMIT = 256 * 2**20
_DIGEST = hashlib.sha256().digest_size


def read_object(folder: Path, key: str) -> bytes | None:
    """Returns the object of a key; None if there is none, or it is damaged, or may be another's."""
    path = folder / f"{key}.o"
    try:
        with open(path, "rb", opener=_open_no_link) as file:
            if not is_trusted(os.fstat(file.fileno())):
                return None
            data = file.read()
    except OSError:
        return None
    with contextlib.suppress(OSError):  # it can only be read
        os.utime(path)
    whole = hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST]
    return data[_DIGEST:] if whole else None


def write_object(folder: Path, key: str, data: bytes, limit: int = LIMIT) -> None:
    """Keeps an object and forgets the oldest; a folder that cannot be written keeps nothing."""
    with contextlib.suppress(OSError):
        make_folder(folder)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".o")
        try:
            with open(handle, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            os.replace(name, folder / f"{key}.o")
        except BaseException:
            os.unlink(name)
            raise
        _forget(folder, limit)


def _open_no_link(path: str, flags: int) -> int:
    """Opens a file, no link to one."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))


def _forget(folder: Path, limit: int) -> None:
    """Removes what was used longest ago until no more than ``limit`` bytes are left."""
    found = []
    for path in folder.glob("*.o"):
        with contextlib.suppress(OSError):  # another process removed it
            found.append((path.stat().st_mtime_ns, path.stat().st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= limit:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size


@functools.cache
def source_digest(*packages: str) -> str:
    """Returns a hash of the files of packages that decide what is compiled."""
    digest = hashlib.sha256()
    for name in packages:
        for file in _files(resources.files(name)):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _files(folder: "Traversable") -> list[Any]:
    """Returns the files of a package that are part of the program, in order of their names."""
    found = []
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.is_dir():
            found += _files(entry)
        elif entry.name.endswith((".py", ".ll", ".xml")):
            found.append(entry)
    return found


def folder() -> Path | None:
    """Returns where compiled objects are kept: beside JAX's programs.

    None if JAX keeps none, and where others may write, of which it warns.
    """
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if not chosen or "://" in chosen or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    folder = Path(chosen) / "native"
    if why := distrust(folder):
        warnings.warn(f"{why}, so no machine code is kept in {folder}", stacklevel=2)
        return None
    return folder
