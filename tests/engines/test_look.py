"""What MJX_REINFORCE_DEBUG says of kernels, and that it breaks nothing."""

import re

import jax.numpy as jnp
import native_items as items
import pytest
from players import actor_and_act
from toys import Drifting

from mjx_reinforce.engines.mapping import machine_code
from mjx_reinforce.engines.native import available, look, objects, program
from mjx_reinforce.engines.native.cpu import machine
from mjx_reinforce.engines.native.gpu import ptx

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

#: Of HalfCheetah's kernel, as ptxas of CUDA 13.0 writes it.
LOG = """ptxas info    : 64 bytes gmem
ptxas info    : Compiling entry function 'play' for 'sm_90'
ptxas info    : Function properties for play
    6960 bytes stack frame, 3336 bytes spill stores, 6160 bytes spill loads
ptxas info    : Used 255 registers, used 1 barriers, 6960 bytes cumulative stack size
ptxas info    : Compile time = 2938.244 ms
"""
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
    monkeypatch.delenv(look.DEBUG, raising=False)


def test_another_value_is_named_with_the_remedy(monkeypatch):
    for value in ("yes", "3", "-1", "1.0", " 1"):
        monkeypatch.setenv(look.DEBUG, value)
        words = f"MJX_REINFORCE_DEBUG is '{value}'; set it to 1 .* unset"
        with pytest.raises(ValueError, match=words):
            available.unavailable()


def test_nothing_is_said_unless_asked(monkeypatch, tmp_path, capfd):
    for number, value in enumerate((None, "", "0")):
        if value is not None:
            monkeypatch.setenv(look.DEBUG, value)
        folder = tmp_path / str(number)
        machine._LOADED.clear()
        key = items.load(folder).key
        assert capfd.readouterr() == ("", "")
        assert [path.name for path in folder.iterdir()] == [f"{key}.o"]
        machine._LOADED.clear()
        assert not items.load(folder).compiled


@pytest.mark.cpu
def test_code_on_disk_is_built_again_and_described(monkeypatch, tmp_path, capfd):
    key = items.load(tmp_path).key
    machine._LOADED.clear()
    monkeypatch.setenv(look.DEBUG, "1")
    assert items.load(tmp_path).compiled
    items.load(tmp_path)  # from memory, without a word
    said = capfd.readouterr().err
    assert said.startswith(f"kernel {key}: ")
    for step in ("tracing and writing out", "LLVM"):
        assert re.search(rf"^  {step}: \d+\.\d\d s$", said, re.MULTILINE)
    assert said.count("machine code") == 1
    assert 500 < int(re.findall(r"machine code: ([\d,]+) bytes", said)[0].replace(",", "")) < 20_000
    assert len(list(tmp_path.iterdir())) == 1


def test_the_texts_are_left_beside_the_objects(monkeypatch, tmp_path, capfd):
    monkeypatch.setenv(look.DEBUG, "2")
    folder = tmp_path / "native"
    key = items.load(folder).key
    assert (folder / f"{key}.ll").read_text() == items.text()
    assert re.search(r"^_?work:", (folder / f"{key}.s").read_text(), re.MULTILINE)
    said = capfd.readouterr().err
    for ending in ("ll", "s"):
        assert f"  text, {ending}: {folder / key}.{ending}\n" in said


def test_a_folder_that_takes_no_texts_breaks_nothing(monkeypatch, tmp_path, capfd):
    (tmp_path / "file").touch()
    monkeypatch.setenv(look.DEBUG, "2")
    for folder, error in ((None, "OSError: no folder"), (tmp_path / "file/native", "FileExistsE")):
        machine._LOADED.clear()
        assert "handler" in items.load(folder).addresses
        said = capfd.readouterr().err
        assert "  machine code: " in said
        assert said.count(f"  no texts: {error}") == 1


def test_the_stack_is_that_of_the_assembly(monkeypatch, tmp_path, capfd):
    target = machine.this_machine()
    if not target.triple.startswith("x86_64"):
        pytest.skip("of x86-64 alone")
    monkeypatch.setenv(look.DEBUG, "2")
    text = """declare void @use(ptr)
    define void @f() {
      %room = alloca [5000 x i8], align 64
      call void @use(ptr %room)
      ret void
    }"""
    machine._build("key", lambda: text, target, tmp_path)
    frames = re.findall(r"andq\s+\$-64, %rsp\s+subq\s+\$(\d+)", (tmp_path / "key.s").read_text())
    assert f"stack of a thread: {int(frames[0]):,} bytes" in capfd.readouterr().err


def test_the_log_of_the_assembler():
    assert look.log_facts(LOG) == {
        "registers of a thread": "255",
        "local memory of a thread": "6,960 bytes",
        "spill stores": "3,336 bytes",
        "spill loads": "6,160 bytes",
        "shared memory of a block": "0 bytes",
    }
    called = LOG.replace("6960 bytes cumulative", "7000 bytes cumulative").replace(
        "size\n", "size, 48 bytes smem\n"
    )
    called += "ptxas info    : Function properties for solve\n    40 bytes stack frame, "
    found = look.log_facts(f"{called}64 bytes spill stores, 40 bytes spill loads\n")
    assert found["local memory of a thread"] == "7,000 bytes"
    assert (found["spill stores"], found["spill loads"]) == ("3,400 bytes", "6,200 bytes")
    assert found["shared memory of a block"] == "48 bytes"
    assert look.log_facts("") == {"the driver's log": "empty"}
    assert look.log_facts("linked\n it") == {"the driver's log": "linked it"}


def test_a_kernel_for_a_gpu(monkeypatch, tmp_path, capfd):
    """Its assembler's log is told where it is assembled: see test_gpu_launch."""
    monkeypatch.setenv(look.DEBUG, "2")
    made = ptx.load_kernel("toy", lambda: KERNEL, "9.0", tmp_path)
    said = capfd.readouterr().err
    assert said.startswith(f"kernel {made.key}: Toy, 7 scalar operations\n")
    for line in (
        "threads of a multiprocessor: 256",
        "long arrays of a thread: 0 bytes",
        f"text, ptx: {tmp_path / made.key}.ptx",
    ):
        assert f"  {line}\n" in said
    assert (tmp_path / f"{made.key}.ptx").read_text() == made.text
    assert (tmp_path / f"{made.key}.ll").read_text() == KERNEL


def test_figures_that_are_not_found_break_nothing(monkeypatch, capfd):
    monkeypatch.setenv(look.DEBUG, "1")
    monkeypatch.setattr(look, "_text_bytes", lambda data: int("no object"))
    assert "handler" in items.load(None).addresses
    assert re.search("^  no figures: ValueError: .*no object", capfd.readouterr().err, re.MULTILINE)


@pytest.mark.cpu
def test_what_is_played_and_mapped_is_named(monkeypatch, capfd):
    class Wrapper(Drifting):
        env = Drifting()

    monkeypatch.setattr(objects, "folder", lambda: None)
    monkeypatch.setenv(look.DEBUG, "1")
    for env, name in ((Drifting(), "Drifting"), (Wrapper(), "Wrapper of Drifting")):
        machine._LOADED.clear()
        actor, act, distribution = actor_and_act(env, (4,))
        program.build_program(env, act, actor, distribution, 20)
        said = capfd.readouterr().err
        assert re.search(rf"^kernel \w{{64}}: {name}, [\d,]+ scalar operations$", said, re.M)

    def doubled(x):
        return x + x

    assert not isinstance(machine_code(Wrapper(), doubled, jnp.float32(0)), str)
    assert ": doubled of Wrapper of Drifting, 1 scalar operations\n" in capfd.readouterr().err
