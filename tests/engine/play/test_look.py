"""What MJX_REINFORCE_DEBUG says of kernels, and that it breaks nothing."""

import re

import jax.numpy as jnp
import native_items as items
import pytest
from players import actor_and_act
from toys import Drifting

from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.gpu import ptx
from mjx_reinforce.engine.play import available, objects, program
from mjx_reinforce.engine.play.choice import machine_code

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

KERNEL = """; Toy, 7 scalar operations
define ptx_kernel void @play(ptr %to) #0 {
  store i32 1, ptr %to
  ret void
}
attributes #0 = { "nvvm.maxntid"="128" "nvvm.minctasm"="2" }
"""


@pytest.fixture(autouse=True)
def nothing_in_memory(monkeypatch):
    monkeypatch.setattr(machine, "_LOADED", {})
    monkeypatch.setattr(ptx, "_LOADED", {})
    monkeypatch.delenv(objects.DEBUG, raising=False)


def test_nothing_is_said_unless_asked(monkeypatch, tmp_path, capfd):
    for number, value in enumerate((None, "", "0")):
        if value is not None:
            monkeypatch.setenv(objects.DEBUG, value)
        folder = tmp_path / str(number)
        machine._LOADED.clear()
        key = items.load(folder).key
        assert capfd.readouterr() == ("", "")
        assert [path.name for path in folder.iterdir()] == [f"{key}.o"]
        machine._LOADED.clear()
        assert not items.load(folder).compiled


@pytest.mark.cpu
def test_code_on_disk_is_built_again_and_described(monkeypatch, tmp_path, capfd):
    """And its text left beside it; nothing is left where nothing is kept."""
    key = items.load(tmp_path).key
    monkeypatch.setenv(objects.DEBUG, "1")
    for folder in (tmp_path, None):
        machine._LOADED.clear()
        assert items.load(folder).compiled
        items.load(folder)  # from memory, without a word
        (said,) = capfd.readouterr().err.splitlines()
        found = re.fullmatch(rf"kernel {key}: .*; LLVM took \d+\.\d\d s for ([\d,]+) bytes", said)
        assert found
        assert 500 < int(found[1].replace(",", "")) < 20_000
    assert (tmp_path / f"{key}.ll").read_text() == items.text()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_kernel_for_a_gpu(monkeypatch, tmp_path, capfd):
    """Its assembler's log is told where it is assembled: see test_gpu_launch."""
    monkeypatch.setenv(objects.DEBUG, "1")
    made = ptx.load_kernel("toy", lambda: KERNEL, "9.0", tmp_path)
    said = capfd.readouterr().err
    assert said.startswith(f"kernel {made.key}: Toy, 7 scalar operations; LLVM took ")
    assert (tmp_path / f"{made.key}.ll").read_text() == KERNEL


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
