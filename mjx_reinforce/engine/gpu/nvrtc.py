"""From CUDA C++ to machine code by NVRTC, NVIDIA's compiler as a library, which pip brings."""

import ctypes
import functools
import importlib.util
import os
from pathlib import Path

_NAMES = ("cu*/lib/libnvrtc.so.??", "cuda_nvrtc/lib/libnvrtc.so.??")
#: Division and roots as XLA's GPU programs have them, and denormals are zero.
_OPTIONS = ("--std=c++17", "-default-device", "-ftz=true", "-prec-div=false", "-prec-sqrt=false")


@functools.cache
def library() -> ctypes.CDLL | None:
    """Returns NVRTC: that of pip, or CUDA's; None if there is none."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = map(Path, (nvidia and nvidia.submodule_search_locations) or [])
    found = [path for folder in folders for name in _NAMES for path in sorted(folder.glob(name))]
    for file in (*found, Path(os.environ.get("CUDA_HOME", "/usr/local/cuda"), "lib64/libnvrtc.so")):
        try:
            return ctypes.CDLL(str(file))
        except OSError:
            continue
    return None


def version() -> str:
    """Returns the version of NVRTC, or why there is none."""
    if (nvrtc := library()) is None:
        return "NVRTC is not found; pip install nvidia-cuda-nvrtc-cu12"
    major, minor = ctypes.c_int(), ctypes.c_int()
    nvrtc.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return f"NVRTC {major.value}.{minor.value}"


def compile(capability: str, text: str) -> tuple[str, bytes]:
    """Returns NVRTC's log and the machine code of a text, for GPUs of a compute capability.

    Raises:
      RuntimeError: the text is no CUDA C++, or NVRTC does not know such GPUs.
    """
    nvrtc, program = library(), ctypes.c_void_p()
    if nvrtc is None:
        raise RuntimeError(version())
    nothing = 0, None, None
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"play.cu", *nothing)
    options = [f"--gpu-architecture=sm_{capability.replace('.', '')}", *_OPTIONS]
    given = (ctypes.c_char_p * len(options))(*(x.encode() for x in options))
    status = nvrtc.nvrtcCompileProgram(program, len(options), given)
    log = _read(nvrtc, program, "ProgramLog").decode(errors="replace").rstrip("\0")
    if status:
        raise RuntimeError(f"NVRTC returned {status}: {' '.join(log.split())[:2000]}")
    made = _read(nvrtc, program, "CUBIN")
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return log, made


def _read(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> bytes:
    """Returns what NVRTC has of a program."""
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
    room = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{what}")(program, room)
    return room.raw
