"""From CUDA C++ to machine code by NVRTC, NVIDIA's compiler as a library, which pip brings."""

import ctypes
import functools
import importlib.util
import os
from pathlib import Path

#: Where pip puts it, in the folder nvidia: for CUDA 13, and for CUDA 12.
_GLOBS = ("cu*/lib/libnvrtc.so.??", "cuda_nvrtc/lib/libnvrtc.so.??")
#: Division and roots as XLA's GPU programs have them, and denormals are zero. The log has the
#: registers, and no warnings of what a kernel does not read.
_OPTIONS = (
    *("--std=c++17", "-default-device", "-ftz=true", "-prec-div=false", "-prec-sqrt=false"),
    *("--ptxas-options=-v", "-w"),
)
_REMEDY = "pip install --upgrade nvidia-cuda-nvrtc-cu12"


@functools.cache
def library() -> ctypes.CDLL | None:
    """Returns NVRTC: that of pip, or CUDA's; None if there is none."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = map(Path, (nvidia and nvidia.submodule_search_locations) or [])
    paths = [path for folder in folders for name in _GLOBS for path in sorted(folder.glob(name))]
    paths.append(Path(os.environ.get("CUDA_HOME", "/usr/local/cuda"), "lib64/libnvrtc.so"))
    for path in paths:
        # A library may be there and still not load, as one of another machine's architecture.
        try:
            return ctypes.CDLL(str(path))
        except OSError:
            continue
    return None


def why_not(capability: str) -> str | None:
    """Returns why NVRTC compiles nothing for a compute capability, such as "9.0", or None."""
    if (nvrtc := library()) is None:
        return f"NVRTC, NVIDIA's compiler, is not found; {_REMEDY}"
    count = ctypes.c_int()
    nvrtc.nvrtcGetNumSupportedArchs(ctypes.byref(count))
    architectures = (ctypes.c_int * count.value)()
    nvrtc.nvrtcGetSupportedArchs(architectures)
    if int(_architecture(capability)) not in architectures:
        return f"{version()} does not know GPUs of compute capability {capability}; {_REMEDY}"
    return None


def version() -> str:
    """Returns the version of NVRTC, which is here (``why_not``)."""
    nvrtc = _present_library()
    major = ctypes.c_int()
    minor = ctypes.c_int()
    nvrtc.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return f"NVRTC {major.value}.{minor.value}"


def _present_library() -> ctypes.CDLL:
    """Returns NVRTC; RuntimeError if it is not here."""
    if (nvrtc := library()) is None:
        raise RuntimeError(f"NVRTC is not found; {_REMEDY}")
    return nvrtc


def _architecture(capability: str) -> str:
    """Returns NVIDIA's number of the GPUs of a compute capability, such as "90"."""
    return capability.replace(".", "")


def compile(capability: str, text: str) -> tuple[str, bytes]:
    """Returns NVRTC's log and the machine code of a text, for GPUs of a compute capability.

    Raises:
      RuntimeError: the text is no CUDA C++, or NVRTC does not know such GPUs, or is not here.
    """
    nvrtc = _present_library()
    program = ctypes.c_void_p()
    no_headers = 0, None, None
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"play.cu", *no_headers)
    # For one architecture by its number (sm_90, not compute_90) NVRTC makes machine code: no PTX
    # that the driver would have to assemble at the first launch.
    options = [f"--gpu-architecture=sm_{_architecture(capability)}", *_OPTIONS]
    option_array = (ctypes.c_char_p * len(options))(*(x.encode() for x in options))
    status = nvrtc.nvrtcCompileProgram(program, len(options), option_array)
    log = _read(nvrtc, program, "ProgramLog").decode(errors="replace").rstrip("\0")
    if status:
        raise RuntimeError(f"NVRTC returned {status}: {' '.join(log.split())[:2000]}")
    cubin = _read(nvrtc, program, "CUBIN")
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return log, cubin


def _read(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, product: str) -> bytes:
    """Returns what NVRTC made of a program, such as "CUBIN": its bytes."""
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{product}Size")(program, ctypes.byref(size))
    buffer = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{product}")(program, buffer)
    return buffer.raw
