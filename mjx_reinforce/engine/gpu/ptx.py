"""From LLVM IR to PTX, the assembly language that NVIDIA's driver takes."""

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.play import objects

#: LLVM's name of NVIDIA's GPUs.
TRIPLE = "nvptx64-nvidia-cuda"
#: What finds a kernel's threads and blocks, and, where it has any, its scratch.
_BOUNDS, _SCRATCH = (r"\.maxntid (\d+)", r"\.minnctapersm (\d+)"), r"\bscratch = (\d+)"
#: What GPUs of compute capability 7.0 need. For one that it does not know, LLVM writes 3.2.
_VERSION, _LEAST_VERSION = r"\.version (\d+\.\d+)", 6.0
_LOADED: dict[str, "Kernel"] = {}
_LOCK = threading.Lock()


class Kernel(NamedTuple):
    """A kernel as PTX.

    key: a name for all that it depends on
    text: PTX; its entry is "play"
    threads: of a block, at most
    blocks: on a multiprocessor; its registers are as many as that leaves each thread
    scratch: 4-byte words of a buffer that each thread needs
    compiled: whether it was compiled now, and not read from disk
    """

    key: str
    text: str
    threads: int
    blocks: int
    scratch: int
    compiled: bool


def load_kernel(
    source: str, write: Callable[[], str], capability: str, folder: Path | None
) -> Kernel:
    """Returns a kernel, compiled unless memory or disk has it.

    Args:
      source: all that the text of the kernel depends on, or a hash of it.
      write: returns ``kernel.kernel_text``.
      capability: the compute capability of the GPU, such as "9.0".
      folder: where kernels are kept; None keeps none.

    Raises:
      UnsupportedPrimitive: the text calls the C library.
      RuntimeError: the text is no LLVM IR, or this LLVM has no code for such a GPU.
    """
    key = objects.key_of(capability, source)

    def compile(text: str) -> bytes:
        return _compile(text, capability).encode()

    with _LOCK:
        if key not in _LOADED:
            found = objects.kept(key, folder)
            made = found or objects.make(key, folder, write(), compile)
            _LOADED[key] = _kernel(key, made, compiled=not found)
        return _LOADED[key]


def in_memory() -> list[str]:
    """Returns the keys of all kernels in memory."""
    return list(_LOADED)


def kept(key: str, folder: Path) -> Kernel | None:
    """Returns a kernel by its key; None if it is not on disk."""
    found = objects.read_object(folder, key)
    return _kernel(key, found, compiled=False) if found else None


def _kernel(key: str, data: bytes, *, compiled: bool) -> Kernel:
    """Returns the kernel that is kept as ``data``."""
    text = data.decode()
    threads, blocks = (int(re.findall(x, text)[0]) for x in _BOUNDS)
    scratch = int((re.findall(_SCRATCH, text) or [0])[0])
    return Kernel(key, text, threads, blocks, scratch, compiled)


def _compile(text: str, capability: str) -> str:
    """Returns PTX."""
    import llvmlite
    import llvmlite.binding as llvm

    if called := re.findall(r"^declare double @(\w+)\(", text, re.M):
        raise scalar.UnsupportedPrimitive(f"{', '.join(called)}: no kernel for GPUs computes it")
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(TRIPLE).create_target_machine(
        cpu=f"sm_{capability.replace('.', '')}", opt=3
    )
    header = f'target datalayout = "{target.target_data}"\ntarget triple = "{TRIPLE}"\n'
    written = target.emit_assembly(llvm.parse_assembly(header + text))
    version = re.findall(_VERSION, written)[0]
    if float(version) < _LEAST_VERSION:
        raise RuntimeError(
            f"llvmlite {llvmlite.__version__} does not know GPUs of compute capability "
            f"{capability}; install a newer one"
        )
    return _with_xla_divisions(written)


def _with_xla_divisions(text: str) -> str:
    """Returns PTX with division as XLA's GPU programs have it, within 2 units in the last place."""
    replaced = text.replace("div.rn.ftz.f32", "div.full.ftz.f32")
    left = re.search(r"\bdiv\.rn\S*\.f32", replaced)
    assert left is None, f"LLVM has another name for a division: {left}"
    return replaced
