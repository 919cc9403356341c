"""Files that are replaced at once, and what a crash or a power cut leaves of them."""

import os
import tracemalloc

import numpy as np
import pytest
from fake_sweeps import make_sweep
from measured_runs import ONE

from mjx_reinforce import files
from mjx_reinforce.reports.sources import read_directory
from mjx_reinforce.runs.results import read_results
from mjx_reinforce.runs.sweep_saving import SweepFiles


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
    with pytest.raises(OSError, match=r"No space left on device: '.*/config.json'"):
        files.write_bytes(tmp_path / "config.json", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_bytes() == b"old"


def test_rows_are_added_to_a_file_that_is_there(tmp_path):
    """In a directory that was moved and made anew there is none, and none without a head begins."""
    path = tmp_path / "metrics.csv"
    with pytest.raises(FileNotFoundError):
        files.append(path, b"1,2\n")
    assert not path.exists()
    path.write_bytes(b"a,b\n")
    files.append(path, b"1,2\n")
    assert path.read_bytes() == b"a,b\n1,2\n"


READERS = {"report": read_directory, "results": read_results}
#: 64 MiB of zeros and a number more, of which a compressed archive holds some 65 kB.
ZEROS = np.zeros(2**23 + 1)


def pack(directory, **arrays):
    """Writes the curves of a sweep again, compressed, with these in place of its own."""
    path = make_sweep(directory, num_seeds=2, evaluations=3, over=ONE) / "curves.npz"
    with np.load(path) as archive:
        np.savez_compressed(path, **(dict(archive) | arrays))
    assert path.stat().st_size < 2**20


@pytest.mark.parametrize("reader", READERS)
def test_an_array_that_nobody_reads_takes_no_memory(tmp_path, reader):
    pack(tmp_path, others=ZEROS)
    tracemalloc.start()
    try:
        READERS[reader](tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 2**23
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("reader", READERS)
def test_few_bytes_that_ask_for_many_are_refused(tmp_path, reader):
    pack(tmp_path, eval_return=ZEROS[None])
    with pytest.raises(ValueError, match=r"curves\.npz is damaged: .* its arrays take 0\.1 GB"):
        READERS[reader](tmp_path)


@pytest.mark.parametrize("reader", READERS)
def test_a_missing_array_is_named(tmp_path, reader):
    path = make_sweep(tmp_path, num_seeds=2, evaluations=3, over=ONE) / "curves.npz"
    with np.load(path) as archive:
        np.savez(path, **{name: archive[name] for name in archive if name != "seed"})
    with pytest.raises(ValueError, match=r"curves\.npz is damaged: seed is missing"):
        READERS[reader](tmp_path)


def test_a_compressed_part_of_a_sweep_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(SweepFiles, "_contents", lambda self: {})
    (tmp_path / "parts").mkdir()
    np.savez_compressed(tmp_path / "parts" / "000.npz", seed=np.zeros(2))
    written = SweepFiles(tmp_path, type("Plan", (), {"saved_record": {}}), print)
    with pytest.raises(ValueError, match=r"000\.npz is damaged: .*'seed\.npy' is compressed"):
        written.finished(None, {"status": "interrupted"})


def test_results_without_configurations_are_named(tmp_path):
    make_sweep(tmp_path, num_seeds=2, evaluations=3, over=ONE, configurations=3)
    with pytest.raises(ValueError, match=r"sweep\.json is damaged"):
        read_results(tmp_path)
