"""From PTX to machine code: NVIDIA's ptxas, or the same within the driver."""

import contextlib
import ctypes
import functools
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

#: Names of CUDA's ``CUjit_option`` and ``CUjitInputType``.
_INFO_LOG, _INFO_SIZE, _ERROR_LOG, _ERROR_SIZE, _VERBOSE, _PTX = 3, 4, 5, 6, 12, 1
_LOG_BYTES = 2**16


class Assembler(NamedTuple):
    """What turns PTX into machine code.

    name: with its version
    assemble: PTX -> its log, the machine code; raises whatever it likes
    """

    name: str
    assemble: Callable[[str], tuple[str, bytes]]


def assemblers(capability: str) -> tuple[Assembler, ...]:
    """Returns what may assemble for GPUs of a compute capability, what is preferred first.

    None where there is no driver of NVIDIA's.
    """
    version = ctypes.c_int()
    try:
        ctypes.CDLL("libcuda.so.1").cuDriverGetVersion(ctypes.byref(version))
    except OSError:
        return ()
    found = []
    for path in _programs():
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            said = subprocess.run([path, "--version"], capture_output=True, text=True, check=True)
            name = f"ptxas, {said.stdout.strip().splitlines()[-1]}"
            assemble = functools.partial(_by_program, path, capability)
            found.append(Assembler(name, assemble))
    return (*found, Assembler(f"the driver of CUDA {version.value}", _by_driver))


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


def _by_driver(text: str) -> tuple[str, bytes]:
    """Assembles PTX for JAX's first GPU."""
    import jax

    cuda, data = ctypes.CDLL("libcuda.so.1"), text.encode() + b"\0"
    log, errors = (ctypes.create_string_buffer(_LOG_BYTES) for _ in range(2))
    options = {
        _INFO_LOG: ctypes.addressof(log),
        _INFO_SIZE: _LOG_BYTES,
        _ERROR_LOG: ctypes.addressof(errors),
        _ERROR_SIZE: _LOG_BYTES,
        _VERBOSE: 1,
    }
    names = (ctypes.c_int * len(options))(*options)
    values = (ctypes.c_void_p * len(options))(*options.values())
    context, linker, code = (ctypes.c_void_p() for _ in range(3))
    device, size = ctypes.c_int(), ctypes.c_size_t()

    def call(name: str, *args: Any) -> None:
        if status := getattr(cuda, name)(*args):
            raise RuntimeError(f"{name} returned {status} {errors.value.decode()}")

    with contextlib.ExitStack() as undo:
        call("cuInit", 0)
        call("cuDeviceGet", ctypes.byref(device), jax.local_devices()[0].local_hardware_id)
        call("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
        undo.callback(call, "cuDevicePrimaryCtxRelease_v2", device)
        call("cuCtxPushCurrent_v2", context)
        undo.callback(call, "cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))
        call("cuLinkCreate_v2", len(options), names, values, ctypes.byref(linker))
        undo.callback(call, "cuLinkDestroy", linker)
        given = (data, ctypes.c_size_t(len(data)), b"play", 0, None, None)
        call("cuLinkAddData_v2", linker, _PTX, *given)
        call("cuLinkComplete", linker, ctypes.byref(code), ctypes.byref(size))
        return log.value.decode(), ctypes.string_at(code, size.value)
