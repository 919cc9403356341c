"""How kernels are compiled and launched on a GPU, without one: compiler and driver are ours."""

import ctypes
import re
import threading
import time
import types

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import handler, machine
from mjx_reinforce.engine.gpu import cubin, nvrtc, seam
from mjx_reinforce.engine.gpu.source import Launch
from mjx_reinforce.engine.play import available

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.cpu

POINTER, COUNT = ctypes.c_void_p, ctypes.c_uint
LAUNCH = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, *[COUNT] * 7, *[POINTER] * 3)
TEXT = "// C++\n"
KERNEL = cubin.Kernel("0" * 64, TEXT, Launch(threads=32, blocks=16), compiled=True)
HEAD = '{"threads": 32, "blocks": 16, "scratch": 0, "lanes": 1, "shared": 0}\n'


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
    monkeypatch.setattr(cubin.ctypes, "CDLL", lambda name: made)
    return made


@pytest.fixture
def compiler(monkeypatch):
    """NVRTC 1.0, which makes ``code`` of any text, or fails where that is None; and its texts."""
    made = types.SimpleNamespace(
        version="NVRTC 1.0", code=b"code", texts=[], begins=threading.Event()
    )
    made.begins.set()

    def compile(capability, text):
        assert capability == "9.0"
        assert made.begins.wait(60)
        made.texts.append(text)
        if made.code is None:
            raise RuntimeError("no memory is left")
        return "Used 8 registers", made.code

    monkeypatch.setattr(nvrtc, "version", lambda: made.version)
    monkeypatch.setattr(nvrtc, "compile", compile)
    return made


def handler_of_a_cpu(name):
    """Registers a handler that XLA's CPU runtime calls, which has no stream; returns its slot."""
    stream = "call ptr %get(ptr %asking)"
    text = handler.with_entry(cubin._LAUNCHER, {})
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


def test_a_launch_waits_for_its_kernel(driver, compiler):
    slot = handler_of_a_cpu("waits")
    compiler.begins.clear()
    threading.Thread(target=cubin.fill, args=(slot, KERNEL, "9.0", None)).start()
    threading.Timer(0.2, compiler.begins.set).start()
    began = time.monotonic()
    assert launched("waits", 7, times=3) == 21
    assert time.monotonic() - began > 0.1
    assert (compiler.texts, driver.images) == ([KERNEL.source.for_compiler()], [b"code"])
    assert driver.launches == [(1, (5, 1, 1, 96, 1, 1))] * 3


def test_what_the_driver_does_not_launch_is_an_error(driver, compiler):
    slot = handler_of_a_cpu("is_an_error")
    cubin.fill(slot, KERNEL, "9.0", None)
    assert launched("is_an_error", 1) == 1
    driver.status = 719
    with pytest.raises((RuntimeError, ValueError), match="cuLaunchKernel returned 719"):
        launched("is_an_error", 2)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (b"code", None),
        (b"of another GPU", "cuLibraryLoadData returned 200"),
        (None, "no memory is left"),
    ],
)
def test_the_log_says_why_there_is_no_kernel(
    driver, compiler, monkeypatch, capfd, caplog, code, reason
):
    """The driver refuses to launch nothing."""
    driver.refused = (b"of another GPU",)
    compiler.code = code
    monkeypatch.setenv(objects.DEBUG, "1")
    slot = POINTER()
    cubin.fill(ctypes.addressof(slot), KERNEL, "9.0", None)
    launch, found = (POINTER * 2).from_address(slot.value)
    assert launch == ctypes.cast(driver.cuLaunchKernel, POINTER).value
    assert found == (None if reason else 1)
    assert [record.getMessage() for record in caplog.records] == (
        [f"a kernel is not compiled for this GPU: {reason}"] if reason else []
    )
    said = capfd.readouterr().err
    assert bool(code) == bool(
        re.search(rf"kernel {KERNEL.key}: NVRTC 1.0 took 0.\d\d s: Used 8 registers\n", said)
    )


def test_machine_code_is_kept_for_what_compiled_it(driver, compiler, tmp_path):
    slot = POINTER()

    def fill(version, kernel=KERNEL):
        compiler.version = version
        cubin.fill(ctypes.addressof(slot), kernel, "9.0", tmp_path)
        return len(compiler.texts)

    assert [fill("NVRTC 1.0"), fill("NVRTC 1.0")] == [1, 1]
    assert driver.images == [b"code"] * 2
    assert fill("NVRTC 2.0") == 2
    assert fill("NVRTC 1.0", KERNEL._replace(key="1" * 64)) == 3
    assert fill("NVRTC 1.0") == 3
    assert len(list(tmp_path.iterdir())) == 3


def test_there_is_none_without_a_driver_or_a_compiler_or_where_gpus_differ(monkeypatch):
    """Machine code is for one of them."""
    why_not = seam._why_not_compiled.__wrapped__
    gpus = [type("GPU", (), {"compute_capability": x}) for x in ("9.0", "8.0")]
    monkeypatch.setattr(jax, "local_devices", lambda: gpus)
    assert why_not() == "its kernels are for GPUs of one kind, not 8.0 and 9.0"
    monkeypatch.setattr(jax, "local_devices", lambda: gpus[:1] * 2)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(nvrtc, "why_not", lambda capability: f"no compiler for {capability}")
    with monkeypatch.context() as patch:
        patch.setattr(seam.ctypes, "CDLL", lambda name: None)
        assert why_not() == "no compiler for 9.0"

    def lost(name):
        raise OSError(f"{name}: cannot open")

    monkeypatch.setattr(seam.ctypes, "CDLL", lost)
    assert why_not() == "NVIDIA's driver, libcuda.so.1, is not found"


@pytest.fixture
def in_memory(monkeypatch, tmp_path):
    """A kernel in memory, and how it is launched."""
    monkeypatch.setattr(seam, "_HANDLERS", {})
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    filled, registered = [], []
    monkeypatch.setattr(cubin, "fill", lambda slot, *given: filled.append(given))
    monkeypatch.setattr(
        jax.ffi,
        "register_ffi_target",
        lambda name, _, platform: registered.append((name, platform)),
    )
    monkeypatch.setattr(cubin, "_CACHE", {KERNEL.key: KERNEL})
    return filled, registered


def launch(x):
    return seam._call(KERNEL, (3, 64), [x, x], [x], {1: 0})[0]


def test_a_program_calls_the_handler(in_memory, monkeypatch, tmp_path):
    """Twice: it is registered and filled once."""
    filled, registered = in_memory

    def twice(x):
        return launch(launch(x))

    x = jnp.zeros(1, jnp.int32)
    text = gpu_on_cpu.lowered(monkeypatch, twice, x, fills=True)
    name = f"mjx_reinforce_gpu_{KERNEL.key}"
    calls = [line for line in text.splitlines() if f"custom_call @{name}(" in line]
    assert len(calls) == 2
    for part in ("blocks = 3 : i32", "threads = 64 : i32", "operand_index = 1"):
        assert part in calls[0]
    assert registered == [(name, "CUDA")]
    assert filled == [(KERNEL, "9.0", tmp_path)]


def test_a_launch_outside_of_jit_is_compiled_once(driver, compiler, monkeypatch):
    """The result is written over the second argument, and the kernel adds the first to it."""
    cubin.fill(handler_of_a_cpu("outside_of_jit"), KERNEL, "9.0", None)
    targets = []
    monkeypatch.setattr(seam, "_handler", lambda _: targets.append("outside_of_jit") or targets[0])
    seam._compiled_call.cache_clear()
    x = jnp.array([7], jnp.int32)
    assert [int(launch(x)[0]) for _ in range(3)] == [14] * 3
    assert len(targets) == 1
    assert driver.launches == [(1, (3, 1, 1, 64, 1, 1))] * 3


def test_one_can_wait_for_kernels(in_memory, monkeypatch):
    """Whoever measures the time of launches does not measure the compiler's."""
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    may_end, ended = threading.Event(), []

    def fill(*_):
        may_end.wait(60)
        ended.append(True)

    monkeypatch.setattr(cubin, "fill", fill)
    seam._handler(KERNEL)
    threading.Timer(0.2, may_end.set).start()
    assert not ended
    seam.wait_for_kernels()
    assert ended


def test_few_items_are_for_lanes_as_long_as_each_team_has_one_at_most(monkeypatch):
    monkeypatch.setattr(seam, "_num_processors", lambda: 132)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    few = KERNEL._replace(key="1" * 64, launch=Launch(threads=512, blocks=1, lanes=16))
    kernel = KERNEL._replace(few=few)
    assert seam._sized(kernel, 4_224) == (few, (132, 512))
    assert seam._sized(kernel, 4_225) == (kernel, (133, 32))
    assert seam._sized(KERNEL, 4_224) == (KERNEL, (132, 32))


def test_an_exported_program_finds_its_kernel_again(in_memory, monkeypatch, tmp_path):
    filled, registered = in_memory
    monkeypatch.setattr(seam, "_why_not_compiled", lambda: None)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    checks = list(map(export.DisabledSafetyCheck.custom_call, seam.targets()))
    x = jnp.zeros(1, jnp.int32)
    made = export.export(jax.jit(launch), platforms=("cuda",), disabled_checks=checks)(x)
    content = bytes(made.serialize())
    seam._HANDLERS.clear()
    assert not seam.restore(content)
    objects.write_object(tmp_path, KERNEL.key, (HEAD + TEXT).encode())
    assert seam.restore(content)
    assert registered == [(seam._target(KERNEL.key), "CUDA")] * 2
    assert filled[1] == (KERNEL._replace(compiled=False), "9.0", tmp_path)
    again = jax.jit(export.deserialize(bytearray(content)).call).trace(x)
    assert seam._target(KERNEL.key) in again.lower(lowering_platforms=("cuda",)).as_text()
    monkeypatch.setattr(seam, "_why_not_compiled", lambda: "no driver")
    assert not seam.restore(content)
    assert seam.restore(b"a program without kernels")
