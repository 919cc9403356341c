"""By which name XLA knows machine code, and how a program on disk finds it again."""

import itertools

import native_items as items
import pytest
from native_items import N, T

from mjx_reinforce.engine.cpu import machine, seam
from mjx_reinforce.engine.play import available, objects

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)
pytestmark = pytest.mark.cpu
#: XLA takes one handler of a name, so that each test has code of its own.
NUMBERS = itertools.count(20)


@pytest.fixture
def code(tmp_path, monkeypatch):
    """Code that is on disk, of which this process forgets how it is called."""
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    monkeypatch.setattr(seam, "_KNOWN", set())
    monkeypatch.setattr(machine, "_LOADED", {})
    return items.load(tmp_path, lanes=next(NUMBERS))


def test_the_name_of_a_handler_is_that_of_its_code(code):
    assert seam.targets() == [f"mjx_reinforce_{code.key}"]
    assert len(code.key) == 64


def test_a_program_on_disk_finds_its_code(code, monkeypatch):
    program = b"... mjx_reinforce_" + code.key.encode() + b" ..."
    assert seam.restore(program)
    monkeypatch.setattr(machine, "_LOADED", {})
    assert seam.restore(program * 2)
    assert seam.targets() == [f"mjx_reinforce_{code.key}"]


def test_a_program_without_handlers_needs_none(code, monkeypatch):
    monkeypatch.setattr(objects, "folder", lambda: None)
    assert seam.restore(b"a program")
    assert not seam.restore(b"mjx_reinforce_" + b"0" * 64)


def test_code_that_is_gone_is_not_restored(code, tmp_path, monkeypatch):
    assert not seam.restore(b"mjx_reinforce_" + b"0" * 64)
    monkeypatch.setattr(machine, "_LOADED", {})
    for path in tmp_path.iterdir():
        path.unlink()
    assert not seam.restore(seam._target(code.key).encode())


def test_xla_is_told_once(code, monkeypatch):
    seam.register(code)
    monkeypatch.setattr(seam.jax.ffi, "register_ffi_target", pytest.fail)
    seam.register(code)
    assert [x.shape for x in items.play(code, [1, 1])][:2] == [(2, T, N, 2), (2, T, N, 1)]
