"""Files that are replaced at once, and what a crash or a power cut leaves of them."""

import os

import pytest

from mjx_reinforce import files


def test_contents_are_on_the_disk_before_the_name_and_then_the_name(tmp_path, monkeypatch):
    events, replace = [], os.replace

    def record(*arguments):
        events.append("replaced")
        replace(*arguments)

    def sync(handle):
        size = os.fstat(handle).st_size
        events.append("folder" if os.path.sameopenfile(handle, folder) else size)

    folder = os.open(tmp_path, os.O_RDONLY)
    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", record)
    files.write_bytes(tmp_path / "config.json", b"12345")
    os.close(folder)
    assert events == [5, "replaced", "folder"]
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_a_folder_that_cannot_be_synced_is_none_to_worry_about(tmp_path, monkeypatch):
    def sync(folder):
        raise OSError

    monkeypatch.setattr(files, "_sync", sync)
    files.write_bytes(tmp_path / "config.json", b"12345")
    assert (tmp_path / "config.json").read_bytes() == b"12345"


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_files_have_the_modes_that_the_umask_leaves(tmp_path, monkeypatch, umask):
    """It is of all threads, and is not touched."""
    before = os.umask(umask)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", lambda _: pytest.fail("the umask was set"))
            files.write_bytes(tmp_path / "config.json", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "config.json").stat().st_mode & 0o777 == 0o666 & ~umask


def test_what_cannot_be_replaced_stays(tmp_path, monkeypatch):
    (tmp_path / "config.json").write_bytes(b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        files.write_bytes(tmp_path / "config.json", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_bytes() == b"old"
