"""What MJX_REINFORCE_DEBUG says of kernels, and that it breaks nothing."""

import os
import re
import stat
from pathlib import Path

import jax.numpy as jnp
import native_items as items
import pytest
from players import actor_and_act
from toys import Drifting

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.gpu import cubin
from mjx_reinforce.engine.gpu.source import Launch, Source
from mjx_reinforce.engine.objects import distrust
from mjx_reinforce.engine.play import available, program
from mjx_reinforce.engine.play.choice import machine_code

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

KERNEL = """// Toy, 7 scalar operations
extern "C" __global__ void play(int* to) { *to = 1; }
"""


@pytest.fixture(autouse=True)
def nothing_in_memory(monkeypatch):
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(cubin, "_CACHE", {})
    monkeypatch.delenv(objects.DEBUG, raising=False)


def test_nothing_is_said_unless_asked(monkeypatch, tmp_path, capfd):
    for number, value in enumerate((None, "", "0")):
        if value is not None:
            monkeypatch.setenv(objects.DEBUG, value)
        folder = tmp_path / str(number)
        machine._CACHE.clear()
        key = items.load(folder).key
        assert capfd.readouterr() == ("", "")
        assert [path.name for path in folder.iterdir()] == [f"{key}.o"]
        machine._CACHE.clear()
        assert not items.load(folder).compiled


@pytest.mark.cpu
def test_code_on_disk_is_built_again_and_described(monkeypatch, tmp_path, capfd):
    """And its text left beside it; nothing is left where nothing is kept."""
    key = items.load(tmp_path).key
    monkeypatch.setenv(objects.DEBUG, "1")
    for folder in (tmp_path, None):
        machine._CACHE.clear()
        assert items.load(folder).compiled
        items.load(folder)  # from memory, without a word
        (said,) = capfd.readouterr().err.splitlines()
        found = re.fullmatch(rf"kernel {key}: .*; LLVM took \d+\.\d\d s for ([\d,]+) bytes", said)
        assert found
        assert 500 < int(found[1].replace(",", "")) < 20_000
    assert (tmp_path / f"{key}.ll").read_text() == items.text()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_kernel_for_a_gpu(monkeypatch, tmp_path, capfd):
    """Its compiler's log is told where it is compiled: see test_gpu_launch."""
    monkeypatch.setenv(objects.DEBUG, "1")
    source = Source(KERNEL, Launch(threads=32, blocks=16))
    made = cubin.load_kernel("toy", lambda: source, "9.0", tmp_path)
    said = capfd.readouterr().err
    assert re.fullmatch(rf"kernel {made.key}: Toy, 7 scalar operations; \d+ bytes of C\+\+\n", said)
    assert (tmp_path / f"{made.key}.cu").read_text() == source.for_compiler()


@pytest.mark.cpu
def test_what_is_played_and_mapped_is_named(monkeypatch, capfd):
    class Wrapper(Drifting):
        env = Drifting()

    monkeypatch.setattr(objects, "folder", lambda: None)
    monkeypatch.setenv(objects.DEBUG, "1")
    actor, act, distribution = actor_and_act(Drifting(), (4,))
    program.build_program(Wrapper(), act, actor, distribution, 20)
    said = capfd.readouterr().err
    assert re.search(r"^kernel \w{64}: Wrapper of Drifting, [\d,]+ scalar operations;", said)

    def doubled(x):
        return x + x

    assert not isinstance(machine_code(Wrapper(), doubled, jnp.float32(0)), str)
    assert ": doubled of Wrapper of Drifting, 1 scalar operations;" in capfd.readouterr().err


# -------------------------------------------------------------------------------------------------
# What is loaded as code is this user's or root's, and nobody else may have written it.


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
