"""Runs kernels that are written for a GPU on this CPU, one thread after the other or several."""

import ctypes
import re
import shutil
import subprocess
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from mjx_reinforce.engine.gpu import cubin, seam
from mjx_reinforce.engine.gpu.loops import ENTRY
from mjx_reinforce.engine.play import available

#: A compiler of C++, if there is one.
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
#: What C++ has on a GPU alone.
_ERFINV = ctypes.CFUNCTYPE(ctypes.c_float, ctypes.c_float)(lambda x: float(scipy.special.erfinv(x)))
_THREAD = threading.local()
#: What a thread asks: its number, and how many there are.
_NUMBERS = {
    "first": ctypes.CFUNCTYPE(ctypes.c_int)(lambda: _THREAD.number),
    "stride": ctypes.CFUNCTYPE(ctypes.c_int)(lambda: _THREAD.threads),
}
#: What a thread is on a CPU; see ``thread.h``. Others meet where the text says so.
_PLAYER = """
#define KERNEL void
struct Player {{
  static constexpr int lane = 0;
  bool meet(bool flag) const {{ return flag; }}
  void gather() const {{}}
  void sync() const {{}}
  int next(int* counter) const {{ return __atomic_fetch_add(counter, 1, __ATOMIC_RELAXED); }}
  void add(int* sum, int x) const {{ __atomic_fetch_add(sum, x, __ATOMIC_RELAXED); }}
  int first() const {{ return ((int (*)()){first}ull)(); }}
  int stride() const {{ return ((int (*)()){stride}ull)(); }}
}};
"""
_MEETING = re.compile(r"\bt\.(?:meet\(|(gather)\()")


class Block:
    """Threads that meet, as those of a GPU's block do.

    apart: where they were when they did not all meet at one place; None if that was never
    meetings: how often they met
    """

    def __init__(self, threads):
        self.threads, self.apart, self.meetings = threads, None, 0
        self._here, self._some = [], 0
        self._barrier = threading.Barrier(threads, self._all_here)
        self._meet = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_int)(self._come)

    def text(self, text):
        """Returns C++ that meets here instead, at places with numbers."""
        places = iter(range(10**6))

        def call(found):
            return f"MEET({next(places)}, {'false' * bool(found[1])}"

        address = ctypes.cast(self._meet, ctypes.c_void_p).value
        macro = f"#define MEET(place, flag) ((int (*)(int, int)){address}ull)(place, flag)\n"
        return macro + _MEETING.sub(call, text)

    def _all_here(self):
        self.meetings += 1
        if len({place for place, _ in self._here}) > 1:
            self.apart = sorted(self._here)
        self._some = int(any(flag for _, flag in self._here))
        self._here.clear()

    def _come(self, place, flag):
        if self.apart:
            return 0  # so that loops end
        self._here.append((place, flag))
        try:
            self._barrier.wait(timeout=60)
        except threading.BrokenBarrierError:
            self.apart = self.apart or sorted(self._here)
        return 0 if self.apart else self._some


def compiled(source, block=None):
    """Returns the address of a kernel for this CPU, where each team has one lane.

    Threads meet in a block, or each in a block alone.
    """
    text = source._replace(launch=source.launch._replace(lanes=1)).for_compiler()
    if block:
        text = block.text(text)
    if source.launch.lanes == 1:
        addresses = {k: ctypes.cast(f, ctypes.c_void_p).value for k, f in _NUMBERS.items()}
        text = _PLAYER.format(**addresses) + text
    address = ctypes.cast(_ERFINV, ctypes.c_void_p).value
    text = f"#define erfinvf(x) ((float (*)(float)){address}ull)(x)\n{text}"
    options = ("-std=c++17", "-O0", "-shared", "-fPIC", "-w", "-DREAL=float", "-x", "c++", "-")
    with tempfile.TemporaryDirectory() as folder:
        library = f"{folder}/play.so"
        done = subprocess.run([COMPILER, *options, "-o", library], input=text, text=True)
        assert done.returncode == 0
        return ctypes.cast(ctypes.CDLL(library)[ENTRY], ctypes.c_void_p).value


def run_threads(address, threads, arrays):
    """Runs a kernel's code in so many threads, on pointers to arrays."""
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    kernel = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(pointers))(address)

    def run(number):
        _THREAD.number, _THREAD.threads = number, threads
        kernel(*pointers)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, range(threads)))


def emulate(monkeypatch, threads=1, block=None):
    """Lets the native engine think that this is a GPU, whose kernels run so many threads.

    A test is skipped where nothing compiles them.
    """
    if COMPILER is None:
        pytest.skip("there is no C++ compiler")
    threads = block.threads if block else threads

    def load(source, write, capability, folder):
        assert capability == "9.0"
        assert folder is None or folder.name == "native"
        written = write()
        # The scratch of a team is that of its one lane.
        scratch = written.launch.scratch * written.launch.lanes
        address = compiled(written, block)
        launch = written.launch._replace(scratch=scratch)
        return cubin.Kernel(source, str(address), launch, compiled=True)

    def call(kernel, grid, given, results, aliases):
        size = 32 * -(-threads // 32)

        def run(*given):
            given = [np.array(x, order="C") for x in given]
            made = [np.full(x.shape, 77, x.dtype) for x in results]
            for k, number in aliases.items():
                made[number] = given[k]
            words = kernel.launch.scratch * size
            scratch = [np.full(words, np.nan, np.float32)] * bool(words)
            run_threads(int(kernel.text), threads, [*given, *made, *scratch])
            return made

        return jax.pure_callback(run, results, *given)

    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "kernels_unavailable", lambda: None)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_sized", lambda kernel, items: (kernel, (1, threads)))
    monkeypatch.setattr(cubin, "load_kernel", load)
    monkeypatch.setattr(seam, "_call", call)


def lowered(monkeypatch, function, *args, fills=False):
    """Returns what XLA's compiler for NVIDIA GPUs gets, as text."""
    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "_why_not_compiled", lambda: None)
    if not fills:
        monkeypatch.setattr(seam, "_handler", lambda kernel: seam._target(kernel.key))
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_num_processors", lambda: 132)
    monkeypatch.setattr(seam, "_grid", lambda items, most, blocks: (-(-items // 32), 32))
    traced = jax.jit(function).trace(*jax.tree.map(jnp.asarray, args))
    return traced.lower(lowering_platforms=("cuda",)).as_text()
