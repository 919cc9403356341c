"""From LLVM IR to PTX, the assembly language of NVIDIA's GPUs, and to a handler that launches it.

NVIDIA's ptxas makes machine code of PTX, or else the driver does. XLA compiles a program while the
kernel that it launches is assembled; a launch waits for it.
"""

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import json
import logging
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mjx_reinforce.engine import objects, scalar
from mjx_reinforce.engine.cpu import handler, machine
from mjx_reinforce.engine.gpu import nvrtc
from mjx_reinforce.engine.gpu.kernel import ENTRY
from mjx_reinforce.engine.gpu.source import Language, Launch, Source

#: LLVM's name of NVIDIA's GPUs.
TRIPLE = "nvptx64-nvidia-cuda"
_VERSION = r"\.version (\d+\.\d+)"
#: What GPUs of compute capability 7.0 need. For one that it does not know, LLVM writes 3.2.
_LEAST_VERSION = 6.0
_LOG = logging.getLogger(__name__)
_CACHE: dict[str, "Kernel"] = {}
_LOCK = threading.Lock()


class Kernel(NamedTuple):
    """A kernel as PTX, or as CUDA C++ for teams of lanes.

    key: a name for all that it depends on
    language: "ptx" or "cuda"
    text: its entry is "play"
    launch: how it is launched
    compiled: whether it was compiled now, and not read from disk
    """

    key: str
    language: Language
    text: str
    launch: Launch
    compiled: bool

    @property
    def source(self) -> Source:
        """What its machine code is made of."""
        return Source(self.language, self.text, self.launch)


def load_kernel(
    source: str, write: Callable[[], Source], capability: str, folder: Path | None
) -> Kernel:
    """Returns a kernel, compiled unless memory or disk has it.

    Args:
      source: all that the text of the kernel depends on, or a hash of it.
      write: returns LLVM IR, such as ``kernel.kernel_text``, or CUDA C++, which is compiled later.
      capability: the compute capability of the GPU, such as "9.0".
      folder: where kernels are kept; None keeps none.

    Raises:
      UnsupportedPrimitive: the text calls the C library.
      RuntimeError: the text is no LLVM IR, or this LLVM has no code for such a GPU.
    """
    key = objects.key_of(capability, source)
    with _LOCK:
        if key not in _CACHE:
            cached = objects.kept(key, folder)
            content = cached or _make(key, folder, write(), capability)
            _CACHE[key] = described(key, content, compiled=not cached)
        return _CACHE[key]


def _make(key: str, folder: Path | None, source: Source, capability: str) -> bytes:
    """Returns a kernel as it is kept: a line of JSON, then its text."""

    def compile(text: str) -> bytes:
        """Returns PTX of LLVM IR. CUDA C++ stays as it is: ``fill`` compiles it to machine code."""
        language = source.language
        if language == "llvm":
            language = "ptx"
            text = _compile(text, capability)
        else:
            text = source.text  # without the macros of its launch, which stand in the first line
        metadata = {"language": language, **source.launch._asdict()}
        return f"{json.dumps(metadata)}\n{text}".encode()

    return objects.make(key, folder, source.for_compiler(), compile)


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
    metadata = json.loads(line)
    language = metadata.pop("language")
    return Kernel(key, language, text, Launch(**metadata), compiled)


def _compile(text: str, capability: str) -> str:
    """Returns PTX."""
    import llvmlite
    import llvmlite.binding as llvm

    # A GPU has no C library. What LLVM has itself is declared as @llvm..., which \w does not match.
    if functions := re.findall(r"^declare double @(\w+)\(", text, re.M):
        raise scalar.UnsupportedPrimitive(f"{', '.join(functions)}: no kernel for GPUs computes it")
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(TRIPLE).create_target_machine(
        cpu=f"sm_{capability.replace('.', '')}", opt=3
    )
    header = f'target datalayout = "{target.target_data}"\ntarget triple = "{TRIPLE}"\n'
    assembly = target.emit_assembly(llvm.parse_assembly(header + text))
    version = re.findall(_VERSION, assembly)[0]
    if float(version) < _LEAST_VERSION:
        raise RuntimeError(
            f"llvmlite {llvmlite.__version__} does not know GPUs of compute capability "
            f"{capability}; install a newer one"
        )
    return _with_xla_divisions(assembly)


def _with_xla_divisions(text: str) -> str:
    """Returns PTX with division as XLA's GPU programs have it, within 2 units in the last place."""
    xla_text = text.replace("div.rn.ftz.f32", "div.full.ftz.f32")
    # One that is rounded correctly is a subroutine of many instructions: it would go unnoticed, and
    # slow every kernel, if a later LLVM spelled divisions otherwise.
    exact_division = re.search(r"\bdiv\.rn\S*\.f32", xla_text)
    assert exact_division is None, f"LLVM has another name for a division: {exact_division}"
    return xla_text


_LAUNCHER = Path(__file__).with_name("launcher.ll")
#: CUDA's number of the attribute of a kernel: bytes of shared memory that a launch may ask for.
_SHARED_ATTRIBUTE = 8
#: What slots point to; a launch may read it until the process ends.
_SLOT_VALUES: list[ctypes.Array[ctypes.c_void_p]] = []


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
    # The key is in the text so that each kernel has a module, and with it a slot, of its own.
    text = f"; launches {key}\n{handler.with_entry(_LAUNCHER, {})}"
    functions = ("handler", "slot")
    code = machine.load_module(text, lambda: text, functions, machine.this_machine(), None)
    return code.addresses["handler"], code.addresses["slot"]


def fill(slot: int, kernel: Kernel, assemblers: Sequence[Assembler], folder: Path | None) -> None:
    """Lets a handler launch a kernel. Where nothing assembles it, a launch is an error.

    Args:
      slot: of the handler.
      kernel: what it launches.
      assemblers: what may assemble it, what is preferred first.
      folder: where machine code is kept; None keeps none.
    """
    cuda = ctypes.CDLL("libcuda.so.1")
    handle = ctypes.c_void_p()
    failures = []
    for assembler in assemblers:
        try:
            image = _machine_code(kernel, assembler, folder)
            handle = _in_memory(cuda, image, kernel.launch.shared)
            break
        except Exception as error:  # whatever an assembler or a driver raises
            failures.append(f"not by {assembler.name}: {error}")
            objects.describe(kernel.key, failures[-1])
    if not handle:
        # The launch that fails can only say a number.
        _LOG.error("nothing assembles a kernel for this GPU: %s", "; ".join(failures)[:2000])
    launch = ctypes.cast(cuda.cuLaunchKernel, ctypes.c_void_p)
    _SLOT_VALUES.append((ctypes.c_void_p * 3)(launch, handle, kernel.launch.shared))
    # Last of all, as a launch in another thread reads all three once the slot is not null.
    ctypes.c_void_p.from_address(slot).value = ctypes.addressof(_SLOT_VALUES[-1])


def _machine_code(kernel: Kernel, assembler: Assembler, folder: Path | None) -> bytes:
    """Returns the machine code of a kernel, assembled unless the disk has it."""
    key = hashlib.sha256(f"2 {kernel.key} {assembler.name}".encode()).hexdigest()
    if cached := objects.kept(key, folder):
        return cached
    start = time.perf_counter()
    log, machine_code = assembler.assemble(kernel.source.for_compiler())
    seconds = time.perf_counter() - start
    objects.describe(kernel.key, f"{assembler.name} took {seconds:.2f} s: {log}")
    if folder:
        objects.write_object(folder, key, machine_code)
    return machine_code


def _in_memory(cuda: ctypes.CDLL, image: bytes, num_bytes: int) -> ctypes.c_void_p:
    """Returns the driver's handle of a kernel, for all GPUs that its machine code is for.

    Args:
      cuda: the driver.
      image: machine code, or PTX.
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


def assemblers(capability: str) -> tuple[Assembler, ...]:
    """Returns what may assemble for GPUs of a compute capability, what is preferred first.

    None where there is no driver of NVIDIA's.
    """
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return ()
    programs = []
    for path in _programs():
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            process = subprocess.run(
                [path, "--version"], capture_output=True, text=True, check=True
            )
            name = f"ptxas, {process.stdout.strip().splitlines()[-1]}"
            assemble = functools.partial(_by_program, path, capability)
            programs.append(Assembler(name, assemble))
    # Any driver assembles PTX when it loads it: the last resort.
    return (*programs, Assembler("the driver", lambda text: ("", text.encode() + b"\0")))


def compiler(capability: str) -> Assembler:
    """Returns what compiles CUDA C++ for GPUs of a compute capability."""
    return Assembler(nvrtc.version(), functools.partial(nvrtc.compile, capability))


def _programs() -> list[str]:
    """Returns where ptxas is: that of pip, which JAX brings, on PATH, in CUDA's folder."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = map(Path, (nvidia and nvidia.submodule_search_locations) or [])
    pip_paths = [str(path) for folder in folders for path in sorted(folder.glob("cu*/bin/ptxas"))]
    cuda = f"{os.environ.get('CUDA_HOME', '')}/bin"
    system_paths = shutil.which("ptxas"), shutil.which("ptxas", path=cuda)
    return pip_paths + [path for path in system_paths if path]


def _by_program(path: str, capability: str, text: str) -> tuple[str, bytes]:
    """Assembles PTX with ptxas."""
    architecture = f"-arch=sm_{capability.replace('.', '')}"
    command = [path, "-v", architecture, "/dev/stdin", "-o", "/dev/stdout"]
    process = subprocess.run(command, input=text.encode(), capture_output=True)
    log = process.stderr.decode(errors="replace")
    if process.returncode:
        raise RuntimeError(f"ptxas returned {process.returncode}: {' '.join(log.split())[:300]}")
    return log, process.stdout
