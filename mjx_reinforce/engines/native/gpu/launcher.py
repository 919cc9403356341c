"""A handler of XLA's FFI that launches a kernel, which may still be assembled.

XLA compiles a program while the kernel that it launches is assembled; a launch waits for it.
"""

import ctypes
import hashlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mjx_reinforce.engines.native import look, objects
from mjx_reinforce.engines.native.cpu import handler, machine
from mjx_reinforce.engines.native.gpu.assembler import Assembler
from mjx_reinforce.engines.native.gpu.kernel import ENTRY
from mjx_reinforce.engines.native.gpu.ptx import Kernel

_TEXT = Path(__file__).with_name("launcher.ll")
#: What slots point to; a launch may read it until the process ends.
_FILLED: list[ctypes.Array[ctypes.c_void_p]] = []


class Launcher(NamedTuple):
    """A handler in memory.

    handler: the address of what XLA calls
    slot: the address of a pointer to ``cuLaunchKernel`` and the kernel; a launch waits while it is
    null
    """

    handler: int
    slot: int


def launcher(key: str) -> Launcher:
    """Returns a handler for the kernel of a key, with an empty slot."""
    text = f"; launches {key}\n{handler.with_entry(_TEXT, {})}"
    names, target = ("handler", "slot"), machine.this_machine()
    found = machine.load_module(text, lambda: text, names, target, None).addresses
    return Launcher(found["handler"], found["slot"])


def fill(slot: int, kernel: Kernel, assemblers: Sequence[Assembler], folder: Path | None) -> None:
    """Lets a handler launch a kernel. Where nothing assembles it, a launch is an error.

    Args:
      slot: of the handler.
      kernel: what it launches.
      assemblers: what may assemble it, what is preferred first.
      folder: where machine code is kept; None keeps none.
    """
    cuda = ctypes.CDLL("libcuda.so.1")
    ready = ctypes.c_void_p()
    for assembler in assemblers:
        try:
            ready = _in_memory(cuda, _machine_code(kernel, assembler, folder))
            break
        except Exception as error:  # whatever an assembler or a driver raises
            look.say(f"kernel {kernel.key}: not by {assembler.name}: {error}")
    launch = ctypes.cast(cuda.cuLaunchKernel, ctypes.c_void_p)
    _FILLED.append((ctypes.c_void_p * 2)(launch, ready))
    ctypes.c_void_p.from_address(slot).value = ctypes.addressof(_FILLED[-1])


def _machine_code(kernel: Kernel, assembler: Assembler, folder: Path | None) -> bytes:
    """Returns the machine code of a kernel, assembled unless the disk has it."""
    key = hashlib.sha256(f"1 {kernel.key} {assembler.name}".encode()).hexdigest()
    found = objects.read_object(folder, key) if folder and not look.level() else None
    if found:
        return found
    began = time.perf_counter()
    log, made = assembler.assemble(kernel.text)
    facts = {
        "assembled by": assembler.name,
        "the assembler": f"{time.perf_counter() - began:.2f} s",
        **look.log_facts(log),
        "machine code": f"{len(made):,} bytes",
    }
    for name, value in facts.items():
        look.say(f"kernel {kernel.key}: {name}: {value}")
    if folder:
        objects.write_object(folder, key, made)
    return made


def _in_memory(cuda: ctypes.CDLL, image: bytes) -> ctypes.c_void_p:
    """Returns the driver's handle of a kernel, for all GPUs that its machine code is for."""
    library, kernel = ctypes.c_void_p(), ctypes.c_void_p()
    nothing = None, None, 0
    if status := cuda.cuLibraryLoadData(ctypes.byref(library), image, *nothing, *nothing):
        raise RuntimeError(f"cuLibraryLoadData returned {status}")
    if status := cuda.cuLibraryGetKernel(ctypes.byref(kernel), library, ENTRY.encode()):
        raise RuntimeError(f"cuLibraryGetKernel returned {status}")
    return kernel
