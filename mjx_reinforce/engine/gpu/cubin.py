"""Kernels for NVIDIA's GPUs: their texts, their machine code (cubins), and what launches them.

NVRTC makes machine code of a text while XLA compiles the program that launches it; a launch waits
for it.
"""

import ctypes
import hashlib
import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import handler, machine
from mjx_reinforce.engine.gpu import nvrtc
from mjx_reinforce.engine.gpu.loops import ENTRY
from mjx_reinforce.engine.gpu.source import Launch, Source

_LOG = logging.getLogger(__name__)
_CACHE: dict[str, "Kernel"] = {}
_LOCK = threading.Lock()
_LAUNCHER = Path(__file__).with_name("launcher.ll")
#: CUDA's number of the attribute of a kernel: bytes of shared memory that a launch may ask for.
_SHARED_ATTRIBUTE = 8
#: What slots point to; a launch may read it until the process ends.
_SLOT_VALUES: list[ctypes.Array[ctypes.c_void_p]] = []


class Kernel(NamedTuple):
    """A kernel as CUDA C++.

    key: a name for all that it depends on
    text: its entry is "play"
    launch: how it is launched
    compiled: whether it was written now, and not read from disk
    few: the kernel that plays few items faster, if there is one; see ``team_kernel.for_items``
    """

    key: str
    text: str
    launch: Launch
    compiled: bool
    few: "Kernel | None" = None

    @property
    def source(self) -> Source:
        """What its machine code is made of."""
        return Source(self.text, self.launch)


def load_kernel(
    source: str, write: Callable[[], Source], capability: str, folder: Path | None
) -> Kernel:
    """Returns a kernel, written unless memory or disk has it; ``fill`` compiles it.

    Args:
      source: all that the text of the kernel depends on, or a hash of it.
      write: returns the text, such as ``thread_kernel.player_text``.
      capability: the compute capability of the GPU, such as "9.0".
      folder: where kernels are kept; None keeps none.
    """
    key = objects.key_of(capability, source)
    with _LOCK:
        if key not in _CACHE:
            cached = objects.kept(key, folder)
            content = cached or _make(key, folder, write())
            _CACHE[key] = described(key, content, compiled=not cached)
        return _CACHE[key]


def _make(key: str, folder: Path | None, source: Source) -> bytes:
    """Returns a kernel as it is kept: a line of JSON, then its text."""
    # The text is without the macros of its launch, which stand in the first line.
    content = f"{json.dumps(source.launch._asdict())}\n{source.text}".encode()
    title = source.text.partition("\n")[0].removeprefix("// ")
    objects.describe(key, f"{title}; {len(content):,} bytes of C++")
    objects.keep(key, folder, content, source.for_compiler(), ".cu")
    return content


def in_memory() -> list[str]:
    """Returns the keys of all kernels in memory."""
    return list(_CACHE)


def kept(key: str, folder: Path) -> Kernel | None:
    """Returns a kernel by its key; None if it is not on disk."""
    content = objects.read_object(folder, key)
    return described(key, content, compiled=False) if content else None


def described(key: str, content: bytes, *, compiled: bool) -> Kernel:
    """Returns a kernel from what is kept of it, whose first line says what it is."""
    line, _, text = content.decode().partition("\n")
    return Kernel(key, text, Launch(**json.loads(line)), compiled)


def launcher(key: str) -> tuple[int, int]:
    """Returns the addresses of a handler for the kernel of a key, which XLA calls, and of its slot.

    The slot is a pointer to ``cuLaunchKernel`` and the kernel; a launch waits while it is null.
    """
    # The key is in the text so that each kernel has a module, and with it a slot, of its own.
    text = f"; launches {key}\n{handler.with_entry(_LAUNCHER, {})}"
    functions = ("handler", "slot")
    code = machine.load_module(text, lambda: text, functions, machine.this_machine(), None)
    return code.addresses["handler"], code.addresses["slot"]


def fill(slot: int, kernel: Kernel, capability: str, folder: Path | None) -> None:
    """Lets a handler launch a kernel. Where it cannot be compiled, a launch is an error.

    Args:
      slot: of the handler.
      kernel: what it launches.
      capability: the compute capability of the GPU, such as "9.0".
      folder: where machine code is kept; None keeps none.
    """
    cuda = ctypes.CDLL("libcuda.so.1")
    handle = ctypes.c_void_p()
    try:
        image = _machine_code(kernel, capability, folder)
        handle = _in_memory(cuda, image, kernel.launch.shared)
    except Exception as error:  # whatever NVRTC or the driver raises
        # The launch that fails can only say a number.
        _LOG.error("a kernel is not compiled for this GPU: %s", str(error)[:2000])
    launch = ctypes.cast(cuda.cuLaunchKernel, ctypes.c_void_p)
    _SLOT_VALUES.append((ctypes.c_void_p * 3)(launch, handle, kernel.launch.shared))
    # Last of all, as a launch in another thread reads all three once the slot is not null.
    ctypes.c_void_p.from_address(slot).value = ctypes.addressof(_SLOT_VALUES[-1])


def _machine_code(kernel: Kernel, capability: str, folder: Path | None) -> bytes:
    """Returns the machine code of a kernel, compiled unless the disk has it."""
    compiler = nvrtc.version()
    key = hashlib.sha256(f"2 {kernel.key} {compiler}".encode()).hexdigest()
    if cached := objects.kept(key, folder):
        return cached
    start = time.perf_counter()
    log, machine_code = nvrtc.compile(capability, kernel.source.for_compiler())
    seconds = time.perf_counter() - start
    objects.describe(kernel.key, f"{compiler} took {seconds:.2f} s: {log}")
    if folder:
        objects.write_object(folder, key, machine_code)
    return machine_code


def _in_memory(cuda: ctypes.CDLL, image: bytes, num_bytes: int) -> ctypes.c_void_p:
    """Returns the driver's handle of a kernel, for all GPUs that its machine code is for.

    Args:
      cuda: the driver.
      image: machine code.
      num_bytes: bytes of shared memory that a block is launched with.
    """
    library = ctypes.c_void_p()
    kernel = ctypes.c_void_p()
    # Neither options of the driver's compiler nor of the library: names, values, and how many.
    no_options = None, None, 0
    if status := cuda.cuLibraryLoadData(ctypes.byref(library), image, *no_options, *no_options):
        raise RuntimeError(f"cuLibraryLoadData returned {status}")
    if status := cuda.cuLibraryGetKernel(ctypes.byref(kernel), library, ENTRY.encode()):
        raise RuntimeError(f"cuLibraryGetKernel returned {status}")
    # Without the attribute, a launch that asks for more than 48 KiB of shared memory is an error.
    if num_bytes:
        count = ctypes.c_int()
        cuda.cuDeviceGetCount(ctypes.byref(count))
        for device in range(count.value):
            if status := cuda.cuKernelSetAttribute(_SHARED_ATTRIBUTE, num_bytes, kernel, device):
                raise RuntimeError(f"cuKernelSetAttribute returned {status}")
    return kernel
