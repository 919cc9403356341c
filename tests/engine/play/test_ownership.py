"""What is loaded as code is this user's or root's, and nobody else may have written it."""

import os
import stat
from pathlib import Path

import pytest

from mjx_reinforce.engine.play import objects
from mjx_reinforce.engine.play.objects import distrust


def test_a_folder_that_others_may_write_to_is_not_trusted(tmp_path):
    folder = tmp_path / "cache"
    assert distrust(folder) is None  # it is not there
    folder.mkdir(0o755)
    (tmp_path / "link").symlink_to(folder)
    assert distrust(folder) is None
    for mode in (0o775, 0o757, 0o1777):
        folder.chmod(mode)
        assert distrust(folder) == f"others may write to {folder}"
        assert distrust(tmp_path / "link") == f"others may write to {tmp_path / 'link'}"
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    assert distrust(tmp_path / "circle").startswith("OSError")


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone can give files away")
def test_what_is_another_users_is_not_trusted(tmp_path):
    objects.write_object(tmp_path / "cache", "key", b"data")
    os.chown(tmp_path / "cache" / "key.o", 12345, 12345)
    assert objects.read_object(tmp_path / "cache", "key") is None
    os.chown(tmp_path / "cache", 12345, 12345)
    assert "cache belongs to another user (12345)" in distrust(tmp_path / "cache")


def test_an_object_is_a_file_that_its_user_alone_may_write(tmp_path):
    objects.write_object(tmp_path, "key", b"data")
    assert objects.read_object(tmp_path, "key") == b"data"
    (tmp_path / "key.o").chmod(0o646)
    assert objects.read_object(tmp_path, "key") is None
    (tmp_path / "key.o").chmod(0o600)
    (tmp_path / "key.o").rename(tmp_path / "other.o")
    (tmp_path / "key.o").symlink_to(tmp_path / "other.o")
    assert objects.read_object(tmp_path, "other") == b"data"
    assert objects.read_object(tmp_path, "key") is None
    (tmp_path / "folder.o").mkdir()
    assert objects.read_object(tmp_path, "folder") is None


def test_what_is_kept_is_its_users_alone_whatever_the_umask(tmp_path):
    before = os.umask(0)
    try:
        objects.write_object(tmp_path / "cache" / "native", "key", b"data")
    finally:
        os.umask(before)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "cache").rglob("*")}
    assert modes == {tmp_path / "cache/native": 0o700, tmp_path / "cache/native/key.o": 0o600}
    assert Path(tmp_path / "cache").stat().st_mode & 0o077 == 0
