"""A handler of XLA's FFI that launches a kernel, which may still be assembled.

NVIDIA's ptxas makes machine code of PTX, or else the driver does. XLA compiles a program while the
kernel that it launches is assembled; a launch waits for it.
"""

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mjx_reinforce.engine.cpu import handler, machine
from mjx_reinforce.engine.gpu.kernel import ENTRY
from mjx_reinforce.engine.gpu.ptx import Kernel
from mjx_reinforce.engine.play import objects

_TEXT = Path(__file__).with_name("launcher.ll")
#: What slots point to; a launch may read it until the process ends.
_FILLED: list[ctypes.Array[ctypes.c_void_p]] = []


class Assembler(NamedTuple):
    """What makes of PTX what the driver loads.

    name: with its version
    assemble: PTX -> its log, and what is loaded; raises whatever it likes
    """

    name: str
    assemble: Callable[[str], tuple[str, bytes]]


def launcher(key: str) -> tuple[int, int]:
    """Returns the addresses of a handler for the kernel of a key, which XLA calls, and of its slot.

    The slot is a pointer to ``cuLaunchKernel`` and the kernel; a launch waits while it is null.
    """
    text = f"; launches {key}\n{handler.with_entry(_TEXT, {})}"
    names, target = ("handler", "slot"), machine.this_machine()
    found = machine.load_module(text, lambda: text, names, target, None).addresses
    return found["handler"], found["slot"]


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
            objects.describe(kernel.key, f"not by {assembler.name}: {error}")
    launch = ctypes.cast(cuda.cuLaunchKernel, ctypes.c_void_p)
    _FILLED.append((ctypes.c_void_p * 2)(launch, ready))
    ctypes.c_void_p.from_address(slot).value = ctypes.addressof(_FILLED[-1])


def _machine_code(kernel: Kernel, assembler: Assembler, folder: Path | None) -> bytes:
    """Returns the machine code of a kernel, assembled unless the disk has it."""
    key = hashlib.sha256(f"2 {kernel.key} {assembler.name}".encode()).hexdigest()
    if found := objects.kept(key, folder):
        return found
    began = time.perf_counter()
    log, made = assembler.assemble(kernel.text)
    seconds = time.perf_counter() - began
    objects.describe(kernel.key, f"{assembler.name} took {seconds:.2f} s: {log}")
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


def assemblers(capability: str) -> tuple[Assembler, ...]:
    """Returns what may assemble for GPUs of a compute capability, what is preferred first.

    None where there is no driver of NVIDIA's.
    """
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return ()
    found = []
    for path in _programs():
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            said = subprocess.run([path, "--version"], capture_output=True, text=True, check=True)
            name = f"ptxas, {said.stdout.strip().splitlines()[-1]}"
            assemble = functools.partial(_by_program, path, capability)
            found.append(Assembler(name, assemble))
    return (*found, Assembler("the driver", lambda text: ("", text.encode() + b"\0")))


def _programs() -> list[str]:
    """Returns where ptxas is: that of pip, which JAX brings, on PATH, in CUDA's folder."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = map(Path, (nvidia and nvidia.submodule_search_locations) or [])
    found = [str(path) for folder in folders for path in sorted(folder.glob("cu*/bin/ptxas"))]
    cuda = f"{os.environ.get('CUDA_HOME', '')}/bin"
    return [*found, *filter(None, (shutil.which("ptxas"), shutil.which("ptxas", path=cuda)))]


def _by_program(path: str, capability: str, text: str) -> tuple[str, bytes]:
    """Assembles PTX with ptxas."""
    architecture = f"-arch=sm_{capability.replace('.', '')}"
    command = [path, "-v", architecture, "/dev/stdin", "-o", "/dev/stdout"]
    done = subprocess.run(command, input=text.encode(), capture_output=True)
    log = done.stderr.decode(errors="replace")
    if done.returncode:
        raise RuntimeError(f"ptxas returned {done.returncode}: {' '.join(log.split())[:300]}")
    return log, done.stdout
