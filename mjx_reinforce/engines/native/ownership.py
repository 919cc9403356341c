"""Who may have written what is loaded as code: this user and root alone, or it is not loaded."""

import os
import stat
import sys
from pathlib import Path


def distrust(folder: Path) -> str | None:
    """Returns why others may decide what is in a folder; None if only this user and root may.

    Each place on the way to the folder counts, for who may write there can put another folder in
    its place; but not in a sticky one, as /tmp is. What does not exist yet is no reason.
    """
    if sys.platform == "win32":
        return None
    whole = folder.absolute()
    try:
        real = whole.resolve()
        for place in dict.fromkeys((*whole.parents, whole, *real.parents, real)):
            status = _status(place)
            shielded = status and place not in (whole, real) and status.st_mode & stat.S_ISVTX
            if status and (why := _stranger(place, status, writable=bool(shielded))):
                return why
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror}"
    except RuntimeError as error:  # of Python 3.11 and 3.12, for links in a circle
        return str(error)
    return None


def distrust_contents(folder: Path) -> str | None:
    """Returns why others may have written what is in a folder, at any depth, as ``distrust``.

    In a folder that nobody else may enter, files may be writable.
    """
    if sys.platform == "win32":
        return None
    try:
        closed = not folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH)
        for name in os.listdir(folder):
            place, status = folder / name, _status(folder / name)
            if status and (why := _stranger(place, status, writable=closed)):
                return why
            if status and stat.S_ISDIR(status.st_mode) and (why := distrust_contents(place)):
                return why
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror}"
    return None


def is_trusted(status: os.stat_result) -> bool:
    """Returns whether only this user and root may have written a file."""
    return sys.platform == "win32" or (
        stat.S_ISREG(status.st_mode) and not _stranger(Path(), status, writable=False)
    )


def make_folder(folder: Path) -> None:
    """Makes a folder that only this user may enter, and those above it, where they are not there.

    Raises:
      OSError: it cannot be made, or is a file.
    """
    for place in (*reversed(folder.parents), folder):
        if not place.is_dir():
            place.mkdir(0o700, exist_ok=True)


def _status(place: Path) -> os.stat_result | None:
    """Returns what the file system says of a place, or of a link; None if it is not there."""
    try:
        return place.lstat()
    except FileNotFoundError:
        return None


def _stranger(place: Path, status: os.stat_result, *, writable: bool) -> str | None:
    """Returns why another user may have made or changed a place, None if none may.

    Args:
      place: for the message.
      status: of the place.
      writable: whether it may be so to others.
    """
    if status.st_uid not in (0, os.geteuid()):
        return f"{place} belongs to another user ({status.st_uid})"
    mode = 0 if writable or stat.S_ISLNK(status.st_mode) else status.st_mode
    own_group = mode & stat.S_IWGRP and _is_private(status.st_gid, status.st_uid)
    if mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not own_group):
        return f"others may write to {place}"
    return None


def _is_private(group: int, user: int) -> bool:
    """Returns whether a group has the user alone, as many systems make one for each user.

    Files of such users can be written by that group.
    """
    import grp
    import pwd

    try:
        who, members = pwd.getpwuid(user), grp.getgrgid(group)
    except KeyError:
        return False
    alone = set(members.gr_mem) <= {who.pw_name}
    return alone and who.pw_gid == group and who.pw_name == members.gr_name
