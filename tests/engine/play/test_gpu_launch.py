"""How kernels are assembled and launched on a GPU, without one: by programs and drivers of ours."""

import ctypes
import os
import re
import threading
import time

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import handler, machine
from mjx_reinforce.engine.gpu import ptx, seam
from mjx_reinforce.engine.gpu.ptx import Assembler
from mjx_reinforce.engine.gpu.source import Launch
from mjx_reinforce.engine.play import available

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.cpu

POINTER, COUNT = ctypes.c_void_p, ctypes.c_uint
LAUNCH = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, *[COUNT] * 7, *[POINTER] * 3)
TEXT = "// PTX\n"
KERNEL = ptx.Kernel("0" * 64, "ptx", TEXT, Launch(threads=32, blocks=16), compiled=True)
HEAD = '{"language": "ptx", "threads": 32, "blocks": 16, "scratch": 0, "lanes": 1, "shared": 0}\n'


class Driver:
    """What knows which code it has: the handle of a kernel is the number of its code."""

    def __init__(self, refused=()):
        self.images, self.refused, self.status, self.launches = [], refused, 0, []
        self.cuLaunchKernel = LAUNCH(self._launch)
        self.cuLibraryLoadData, self.cuLibraryGetKernel = self._load, self._get

    def _load(self, library, image, *_):
        if image in self.refused:
            return 200
        self.images.append(image)
        library._obj.value = 1
        return 0

    def _get(self, kernel, library, name):
        assert (library.value, name) == (1, b"play")
        kernel._obj.value = len(self.images)
        return 0

    def _launch(self, kernel, *given):
        """Adds the first buffer to the last one."""
        grid, parameters = given[:6], ctypes.cast(given[8], ctypes.POINTER(POINTER))
        first, *_, last = (
            ctypes.cast(parameters[k], ctypes.POINTER(ctypes.POINTER(ctypes.c_int)))[0]
            for k in range(3)
        )
        last[0] += first[0]
        self.launches.append((kernel, grid))
        return self.status


@pytest.fixture
def driver(monkeypatch):
    made = Driver()
    monkeypatch.setattr(ptx.ctypes, "CDLL", lambda name: made)
    return made


def handler_of_a_cpu(name):
    """Registers a handler that XLA's CPU runtime calls, which has no stream; returns its slot."""
    stream = "call ptr %get(ptr %asking)"
    text = handler.with_entry(ptx._LAUNCHER, {})
    assert stream in text
    text = text.replace(stream, "getelementptr i8, ptr null, i64 0")
    names = ("handler", "slot")
    target = machine.this_machine()
    found = machine.load_module(f"; {name}\n{text}", lambda: text, names, target, None).addresses
    jax.devices()
    capsule = jax.ffi.pycapsule(ctypes.c_void_p(found["handler"]))
    jax.ffi.register_ffi_target(name, capsule, platform="cpu")
    return found["slot"]


def launched(name, x, times=1):
    """Launches a handler's kernel so many times in a loop, each time into its own result."""

    def add(_, y):
        call = jax.ffi.ffi_call(
            name, jax.ShapeDtypeStruct((1,), y.dtype), input_output_aliases={1: 0}
        )
        return call(jnp.array([x], jnp.int32), y, threads=np.int32(96), blocks=np.int32(5))

    return int(jax.jit(lambda y: jax.lax.fori_loop(0, times, add, y))(jnp.zeros(1, jnp.int32))[0])


def by(name, code=b"code", calls=None):
    """Returns an assembler."""

    def assemble(text):
        (calls if calls is not None else []).append(text)
        if code is None:
            raise RuntimeError("no memory is left")
        return "Used 8 registers", code

    return Assembler(name, assemble)


def test_a_launch_waits_for_its_kernel(driver):
    slot = handler_of_a_cpu("waits")
    assembling = threading.Event()
    slow = Assembler("slow", lambda text: (assembling.wait(60) and "", text.encode()))
    threading.Thread(target=ptx.fill, args=(slot, KERNEL, (slow,), None)).start()
    threading.Timer(0.2, assembling.set).start()
    began = time.monotonic()
    assert launched("waits", 7, times=3) == 21
    assert time.monotonic() - began > 0.1
    assert driver.images == [TEXT.encode()]
    assert driver.launches == [(1, (5, 1, 1, 96, 1, 1))] * 3


def test_what_the_driver_does_not_launch_is_an_error(driver):
    slot = handler_of_a_cpu("is_an_error")
    ptx.fill(slot, KERNEL, (by("ptxas"),), None)
    assert launched("is_an_error", 1) == 1
    driver.status = 719
    with pytest.raises((RuntimeError, ValueError), match="cuLaunchKernel returned 719"):
        launched("is_an_error", 2)


def test_the_next_assembler_is_tried(driver, monkeypatch, capfd, caplog):
    """Where none can, the log says why; the driver refuses to launch nothing."""
    driver.refused = (b"of another GPU",)
    monkeypatch.setenv(objects.DEBUG, "1")
    slot = POINTER()
    for new, old, kernel in (
        (b"new", b"old", 1),
        (b"of another GPU", b"old", 1),
        (None, b"old", 1),
        (None, None, None),
    ):
        driver.images.clear()
        ptx.fill(ctypes.addressof(slot), KERNEL, (by("new", new), by("old", old)), None)
        launch, found = (POINTER * 2).from_address(slot.value)
        assert launch == ctypes.cast(driver.cuLaunchKernel, POINTER).value
        assert found == kernel
        assert ("nothing assembles" in caplog.text) == (kernel is None)
        said = capfd.readouterr().err
        if driver.images == [b"new"]:
            assert re.search(rf"kernel {KERNEL.key}: new took 0.\d\d s: Used 8 registers\n", said)
        else:
            assert f"kernel {KERNEL.key}: not by new: " in said


def test_machine_code_is_kept_for_what_assembled_it(driver, tmp_path):
    calls, slot = [], POINTER()

    def fill(name, kernel=KERNEL):
        ptx.fill(ctypes.addressof(slot), kernel, (by(name, b"code", calls),), tmp_path)
        return len(calls)

    assert [fill("ptxas 1"), fill("ptxas 1")] == [1, 1]
    assert driver.images == [b"code"] * 2
    assert fill("ptxas 2") == 2
    assert fill("ptxas 1", KERNEL._replace(key="1" * 64)) == 3
    assert fill("ptxas 1") == 3
    assert len(list(tmp_path.iterdir())) == 3


def program(path, said, does):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo "{said}"; else {does}; fi\n')
    path.chmod(0o755)


def test_pips_assembler_comes_first(tmp_path, monkeypatch):
    """Then that on PATH, that of CUDA_HOME, and the driver; what does not run is left out."""
    echo = 'echo "Used 8 registers for $2" >&2; cat'
    for place in ("nvidia/cuda_nvcc", "nvidia/cu13", "home", "path", "broken"):
        program(tmp_path / place / "bin" / "ptxas", f"Copyright\n{place}", echo)
    (tmp_path / "broken" / "bin" / "ptxas").write_text("#!/nowhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(ptx.ctypes, "CDLL", lambda name: None)
    monkeypatch.setenv("PATH", f"{tmp_path / 'path' / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    found = ptx.assemblers("9.0")
    ours = [x for x in found if "nvidia" in x.name or x.name in ("ptxas, path", "ptxas, home")]
    assert [x.name for x in ours] == [
        *("ptxas, nvidia/cu13", "ptxas, nvidia/cuda_nvcc", "ptxas, path", "ptxas, home")
    ]
    assert found[-1].name == "the driver"
    assert found[-1].assemble("text") == ("", b"text\0")
    assert found[0].assemble("text") == ("Used 8 registers for -arch=sm_90\n", b"text")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "broken"))
    assert "ptxas, home" not in [x.name for x in ptx.assemblers("9.0")]


def test_there_is_none_without_a_driver_and_one_that_fails_says_why(tmp_path, monkeypatch):
    program(tmp_path / "nvidia" / "cu13" / "bin" / "ptxas", "1", "echo no such GPU >&2; exit 3")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(ptx.ctypes, "CDLL", lambda name: None)
    with pytest.raises(RuntimeError, match="ptxas returned 3: no such GPU"):
        ptx.assemblers("99.0")[0].assemble("text")

    def lost(name):
        raise OSError(f"{name}: cannot open")

    monkeypatch.setattr(ptx.ctypes, "CDLL", lost)
    assert ptx.assemblers("9.0") == ()


def test_there_is_none_where_gpus_differ(monkeypatch):
    """Machine code is for one of them."""
    found = tuple(map(by, ("new", "driver")))
    monkeypatch.setattr(ptx, "assemblers", lambda capability: found)
    assemblers = seam._assemblers.__wrapped__
    gpus = [type("GPU", (), {"compute_capability": x}) for x in ("9.0", "8.0")]
    monkeypatch.setattr(jax, "local_devices", lambda: gpus)
    assert assemblers() == ((), "its kernels are for GPUs of one kind, not 8.0 and 9.0")
    monkeypatch.setattr(jax, "local_devices", lambda: gpus[:1] * 2)
    assert assemblers() == (found, None)
    monkeypatch.setattr(ptx, "assemblers", lambda capability: ())
    assert assemblers() == ((), "NVIDIA's driver, libcuda.so.1, is not found")


@pytest.fixture
def in_memory(monkeypatch, tmp_path):
    """A kernel in memory, and how it is launched."""
    monkeypatch.setattr(seam, "_HANDLERS", set())
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    filled, registered = [], []
    monkeypatch.setattr(ptx, "fill", lambda slot, *given: filled.append(given))
    monkeypatch.setattr(
        jax.ffi,
        "register_ffi_target",
        lambda name, _, platform: registered.append((name, platform)),
    )
    monkeypatch.setattr(ptx, "_CACHE", {KERNEL.key: KERNEL})
    return filled, registered


def launch(x):
    return seam._call(KERNEL, (3, 64), [x], [x], [x])[0]


def test_a_program_calls_the_handler(in_memory, monkeypatch, tmp_path):
    """Twice: it is registered and filled once."""
    filled, registered = in_memory
    assemblers = (by("ptxas"), by("driver"))

    def twice(x):
        return launch(launch(x))

    x = jnp.zeros(1, jnp.int32)
    text = gpu_on_cpu.lowered(monkeypatch, twice, x, assemblers=assemblers)
    name = f"mjx_reinforce_gpu_{KERNEL.key}"
    calls = [line for line in text.splitlines() if f"custom_call @{name}(" in line]
    assert len(calls) == 2
    for part in ("blocks = 3 : i32", "threads = 64 : i32", "operand_index = 1"):
        assert part in calls[0]
    assert registered == [(name, "CUDA")]
    assert filled == [(KERNEL, assemblers, tmp_path)]


def test_an_exported_program_finds_its_kernel_again(in_memory, monkeypatch, tmp_path):
    filled, registered = in_memory
    assemblers = (by("ptxas"),)
    monkeypatch.setattr(seam, "_assemblers", lambda: (assemblers, None))
    checks = list(map(export.DisabledSafetyCheck.custom_call, seam.targets()))
    x = jnp.zeros(1, jnp.int32)
    made = export.export(jax.jit(launch), platforms=("cuda",), disabled_checks=checks)(x)
    content = bytes(made.serialize())
    seam._HANDLERS.clear()
    assert not seam.restore(content)
    objects.write_object(tmp_path, KERNEL.key, (HEAD + TEXT).encode())
    assert seam.restore(content)
    assert registered == [(seam._target(KERNEL.key), "CUDA")] * 2
    assert filled[1] == (KERNEL._replace(compiled=False), assemblers, tmp_path)
    again = jax.jit(export.deserialize(bytearray(content)).call).trace(x)
    assert seam._target(KERNEL.key) in again.lower(lowering_platforms=("cuda",)).as_text()
    monkeypatch.setattr(seam, "_assemblers", lambda: ((), "no driver"))
    assert not seam.restore(content)
    assert seam.restore(b"a program without kernels")
