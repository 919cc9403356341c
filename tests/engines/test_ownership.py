"""What is loaded as code is this user's or root's, and nobody else may have written it."""

import os
import stat
from pathlib import Path

import pytest

from mjx_reinforce.engines.native import objects, ownership
from mjx_reinforce.engines.native.ownership import distrust, distrust_contents, is_trusted

ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="root alone can give files away")


@pytest.fixture
def cache(tmp_path):
    """A folder, and its parent, that nobody else may write to."""
    (tmp_path / "home" / "cache").mkdir(parents=True, mode=0o755)
    return tmp_path / "home" / "cache"


def status(mode, user=None, group=99999):
    user = os.geteuid() if user is None else user
    return os.stat_result((mode, 0, 0, 1, user, group, 0, 0, 0, 0))


def test_a_folder_of_ones_own_is_trusted_and_one_that_is_not_there(cache):
    assert distrust(cache) is None
    assert distrust(cache / "native" / "deep") is None
    assert distrust_contents(cache) is None


def test_others_may_write_nowhere_on_the_way(cache):
    for place in (cache, cache.parent):
        place.chmod(0o777)
        assert distrust(cache / "native").startswith("others may write to")
        place.chmod(0o755)
    cache.parent.chmod(0o1777)  # as /tmp is
    assert distrust(cache / "native") is None
    cache.chmod(0o1777)  # a sticky folder is none for code
    assert distrust(cache) == f"others may write to {cache}"


def test_links_lead_to_what_counts(cache):
    (cache / "link").symlink_to(cache / "real")
    (cache / "real").mkdir()
    assert distrust(cache / "link") is None
    (cache / "real").chmod(0o777)
    assert distrust(cache / "link") == f"others may write to {cache / 'real'}"
    (cache / "circle").symlink_to(cache / "circle")
    distrust(cache / "circle")  # no traceback


@ROOT
def test_no_folder_and_no_link_of_another_user_is_trusted(cache):
    (cache / "real").mkdir()
    (cache / "link").symlink_to(cache / "real")
    os.lchown(cache / "link", 12345, 12345)
    assert "link belongs to another user (12345)" in distrust(cache / "link")
    assert "link belongs to another user (12345)" in distrust_contents(cache)
    os.chown(cache, 12345, 12345)
    assert "cache belongs to another user (12345)" in distrust(cache / "real")


def test_files_that_others_may_write_are_found_at_any_depth(cache):
    (cache / "a" / "b").mkdir(parents=True)
    file = cache / "a" / "b" / "file"
    file.touch()
    file.chmod(0o666)
    assert distrust_contents(cache) == f"others may write to {file}"
    (cache / "a" / "b").chmod(0o700)  # where others cannot reach it
    assert distrust_contents(cache) is None


def test_the_group_that_a_user_is_alone_in_may_write(monkeypatch):
    shared = status(stat.S_IFREG | 0o664)
    assert not is_trusted(shared)
    monkeypatch.setattr(ownership, "_is_private", lambda *_: True)
    assert is_trusted(shared)
    assert not is_trusted(status(stat.S_IFREG | 0o666))


def test_whose_files_are_trusted():
    for mode, user, trusted in (
        (stat.S_IFREG | 0o644, None, True),
        (stat.S_IFREG | 0o644, 0, True),
        (stat.S_IFREG | 0o644, 12345, False),
        (stat.S_IFREG | 0o646, 0, False),
        (stat.S_IFLNK | 0o644, None, False),
        (stat.S_IFIFO | 0o644, None, False),
    ):
        assert is_trusted(status(mode, user)) == trusted, (oct(mode), user)


def test_an_object_that_is_a_link_is_none(tmp_path):
    objects.write_object(tmp_path, "key", b"data")
    (tmp_path / "key.o").rename(tmp_path / "other.o")
    (tmp_path / "key.o").symlink_to(tmp_path / "other.o")
    assert objects.read_object(tmp_path, "other") == b"data"
    assert objects.read_object(tmp_path, "key") is None


def test_what_is_kept_is_its_users_alone_whatever_the_umask(tmp_path):
    before = os.umask(0)
    try:
        objects.write_object(tmp_path / "cache" / "native", "key", b"data")
    finally:
        os.umask(before)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "cache").rglob("*")}
    assert modes == {tmp_path / "cache/native": 0o700, tmp_path / "cache/native/key.o": 0o600}
    assert Path(tmp_path / "cache").stat().st_mode & 0o077 == 0
