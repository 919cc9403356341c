"""Compiled objects: made, described and kept on disk.

They are written whole or not at all, checked when read, bounded in size. They are code: only what
nobody but this user and root may have written is read.

With the variable MJX_REINFORCE_DEBUG=1, for work on the compiler, each object is made even if the
disk has it, described on stderr, and the text that it is made of is left beside it.
"""

import contextlib
import functools
import hashlib
import os
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from mjx_reinforce.engine.checks import check_name

#: Asks for descriptions.
DEBUG = "MJX_REINFORCE_DEBUG"
#: Where a folder holds more bytes than this, what was used longest ago goes.
LIMIT = 256 * 2**20
_DIGEST = hashlib.sha256().digest_size


def key_of(*parts: object) -> str:
    """Returns the key of an object: a hash of all that it depends on, this LLVM besides."""
    import llvmlite
    import llvmlite.binding as llvm

    # The first part is the version of these keys: another one makes every object anew.
    compiler = "1", llvmlite.__version__, llvm.llvm_version_info
    return hashlib.sha256("\n".join(map(str, (*compiler, *parts))).encode()).hexdigest()


def read_object(folder: Path, key: str) -> bytes | None:
    """Returns the object of a key; None if there is none, or it is damaged, or may be another's."""
    path = folder / f"{key}.o"
    try:
        with open(path, "rb", opener=_open_no_link) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or _stranger(path, status):
                return None
            data = file.read()
    except OSError:
        return None
    # The time of its last use, by which ``_forget`` goes. A folder may be readable only.
    with contextlib.suppress(OSError):
        os.utime(path)
    digest = data[:_DIGEST]
    content = data[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        return None
    return content


def write_object(folder: Path, key: str, data: bytes, limit: int = LIMIT) -> None:
    """Keeps an object and forgets the oldest; a folder that cannot be written keeps nothing."""
    # Into a file of another name, which then replaces the object at once: whoever reads meanwhile,
    # or is there after a kill, finds the old one or the new one, whole.
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
    files = []
    for path in folder.glob("*.o"):
        with contextlib.suppress(OSError):  # another process removed it
            files.append((path.stat().st_mtime_ns, path.stat().st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= limit:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size


@functools.cache
def source_digest(*packages: str) -> str:
    """Returns a hash of the files of packages that decide what is compiled."""
    # In one order on every machine, so that the same sources have the same hash.
    digest = hashlib.sha256()
    for name in packages:
        with resources.as_file(resources.files(name)) as folder:
            for place, _, file_names in sorted(os.walk(folder, followlinks=True)):
                for file in sorted(file_names):
                    if file.endswith((".py", ".ll", ".h", ".xml")):
                        digest.update(Path(place, file).read_bytes())
    return digest.hexdigest()


def folder() -> Path | None:
    """Returns where compiled objects are kept: beside JAX's programs.

    None if JAX keeps none, and where others may write, of which it warns.
    """
    import jax  # here alone: commands that compute nothing do not wait for it

    cache_dir = jax.config.values["jax_compilation_cache_dir"]
    is_enabled = jax.config.values["jax_enable_compilation_cache"]
    # JAX also takes a bucket, such as gs://..., where no file can be checked for its owner.
    if not cache_dir or "://" in cache_dir or not is_enabled:
        return None
    folder = Path(cache_dir) / "native"
    reason = distrust(folder)
    if reason:
        warnings.warn(f"{reason}, so no machine code is kept in {folder}", stacklevel=2)
        return None
    return folder


def distrust(folder: Path) -> str | None:
    """Returns why others may decide what is in a folder; None if only this user and root may.

    What does not exist yet is no reason: ``make_folder`` makes it.
    """
    try:
        status = folder.stat()
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror}"
    return _stranger(folder, status)


def _stranger(place: Path, status: os.stat_result) -> str | None:
    """Returns why another user may have made or changed a place, None if none may."""
    if sys.platform == "win32":
        return None
    if status.st_uid not in (0, os.geteuid()):
        return f"{place} belongs to another user ({status.st_uid})"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to {place}"
    return None


def make_folder(folder: Path) -> None:
    """Makes a folder that only this user may enter, and those above it, where they are not there.

    Raises:
      OSError: it cannot be made, or is a file.
    """
    # From the root down, each by itself: ``parents=True`` would make those above with all rights.
    for place in (*reversed(folder.parents), folder):
        if not place.is_dir():
            place.mkdir(0o700, exist_ok=True)


def is_described() -> bool:
    """Returns whether objects are described, and therefore made even if the disk has them.

    Raises:
      ValueError: the variable is neither 0 nor 1.
    """
    value = os.environ.get(DEBUG) or "0"
    check_name(DEBUG, value, {"0": False, "1": True})
    return value == "1"


def describe(key: str, description: str) -> None:
    """Says something of an object on stderr where that is asked for."""
    if is_described():
        print(f"kernel {key}: {' '.join(description.split())}", file=sys.stderr, flush=True)


def kept(key: str, folder: Path | None) -> bytes | None:
    """Returns an object that need not be made; None if there is none."""
    if not folder or is_described():
        return None
    return read_object(folder, key)


def make(key: str, folder: Path | None, text: str, compile: Callable[[str], bytes]) -> bytes:
    """Returns what is compiled of a text, and keeps it.

    Args:
      key: of the object.
      folder: where it is kept; None keeps none.
      text: LLVM IR, whose first line says what it is.
      compile: returns what is kept.
    """
    start = time.perf_counter()
    content = compile(text)
    seconds = time.perf_counter() - start
    title = text.partition("\n")[0].removeprefix("; ")
    describe(key, f"{title}; LLVM took {seconds:.2f} s for {len(content):,} bytes")
    keep(key, folder, content, text, ".ll")
    return content


def keep(key: str, folder: Path | None, content: bytes, text: str, suffix: str) -> None:
    """Keeps an object, and where objects are described the text that it is made of beside it."""
    if folder is None:
        return
    write_object(folder, key, content)
    if is_described():
        with contextlib.suppress(OSError):
            (folder / f"{key}{suffix}").write_text(text, encoding="utf-8")
