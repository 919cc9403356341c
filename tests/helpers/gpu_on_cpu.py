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
import scipy.special

from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.gpu import ptx, seam
from mjx_reinforce.engine.gpu.kernel import ENTRY
from mjx_reinforce.engine.gpu.source import Launch
from mjx_reinforce.engine.play import available

#: A compiler of C++, if there is one.
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
_SOME = re.compile(r'call i32 asm sideeffect "[^"]*bar.red[^"]*", "=r,r"\(i32 (%\w+)\) convergent')
_ALL = re.compile(r'call void asm sideeffect "[^"]*bar.sync[^\n]*')
#: What C++ has on a GPU alone.
_ERFINV = ctypes.CFUNCTYPE(ctypes.c_float, ctypes.c_float)(lambda x: float(scipy.special.erfinv(x)))
_THREAD = threading.local()
#: What a thread asks, in blocks of 32.
_NUMBERS = {
    "tid": ctypes.CFUNCTYPE(ctypes.c_int)(lambda: _THREAD.number % 32),
    "ctaid": ctypes.CFUNCTYPE(ctypes.c_int)(lambda: _THREAD.number // 32),
    "ntid": ctypes.CFUNCTYPE(ctypes.c_int)(lambda: 32),
}


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
        """Returns LLVM IR that meets here instead."""
        address = ctypes.cast(self._meet, ctypes.c_void_p).value
        places = iter(range(10**6))

        def call(flag):
            where = f"inttoptr (i64 {address} to ptr)"
            return f"call i32 {where}(i32 {next(places)}, i32 {flag})"

        return _ALL.sub(lambda _: call("0"), _SOME.sub(lambda found: call(found[1]), text))

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


def as_for_a_cpu(text, block=None):
    """Returns a kernel's LLVM IR, with threads that meet in a block, or each in a block alone."""
    text = text.replace("define ptx_kernel void", "define void").replace(") #0 {", ") {")
    text = re.sub(r"attributes #0 = \{[^}]*\}", "", text)
    for name, function in _NUMBERS.items():
        address = ctypes.cast(function, ctypes.c_void_p).value
        asked = f"call i32 @llvm.nvvm.read.ptx.sreg.{name}.x()"
        text = text.replace(asked, f"call i32 inttoptr (i64 {address} to ptr)()")
    return block.text(text) if block else _ALL.sub("", _SOME.sub(r"or i32 \1, 0", text))


def compiled(text, block=None):
    """Returns a kernel's code for this CPU."""
    text = as_for_a_cpu(text, block)
    return machine.load_module(text, lambda: text, (ENTRY,), machine.this_machine(), None)


def compiled_team(source):
    """Returns the address of a kernel in CUDA C++, compiled with one lane for this CPU."""
    with tempfile.TemporaryDirectory() as folder:
        library = f"{folder}/play.so"
        options = ("-std=c++17", "-O1", "-shared", "-fPIC", "-w", "-DREAL=float", "-x", "c++", "-")
        address = ctypes.cast(_ERFINV, ctypes.c_void_p).value
        text = source._replace(launch=source.launch._replace(lanes=1)).for_compiler()
        text = f"#define erfinvf(x) ((float (*)(float)){address}ull)(x)\n{text}"
        done = subprocess.run([COMPILER, *options, "-o", library], input=text, text=True)
        assert done.returncode == 0
        return ctypes.cast(ctypes.CDLL(library)[ENTRY], ctypes.c_void_p).value


def run_threads(address, threads, arrays):
    """Runs a kernel's code in so many threads, on pointers to arrays."""
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    kernel = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(pointers))(address)

    def run(number):
        _THREAD.number = number
        kernel(*pointers)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, range(threads)))


def emulate(monkeypatch, threads=1, block=None):
    """Lets the native engine think that this is a GPU, whose kernels run so many threads."""
    threads = block.threads if block else threads

    def load(source, write, capability, folder):
        assert capability == "9.0"
        assert folder is None or folder.name == "native"
        written = write()
        launch = written.launch
        if written.language == "cuda":
            # The scratch of a team is that of its one lane.
            launch = launch._replace(scratch=launch.scratch * launch.lanes)
            address = compiled_team(written)
            return ptx.Kernel(source, "cuda", str(address), launch, compiled=True)
        code = compiled(written.text, block)
        return ptx.Kernel(
            code.key, "ptx", str(code.addresses[ENTRY]), Launch(256, 1), compiled=True
        )

    def call(kernel, grid, given, first, results):
        size = 32 * -(-threads // 32)

        def run(*given):
            given = [np.array(x, order="C") for x in given]
            made = [np.full(x.shape, 0 if first else 77, x.dtype) for x in results]
            words = kernel.launch.scratch * size
            scratch = [np.full(words, np.nan, np.float32)] * bool(words)
            run_threads(int(kernel.text), threads, [*given, *made * bool(first), *made, *scratch])
            return made

        return jax.pure_callback(run, results, *given)

    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "kernels_unavailable", lambda: None)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_sized", lambda kernel, items: (kernel, (1, threads)))
    monkeypatch.setattr(ptx, "load_kernel", load)
    monkeypatch.setattr(seam, "_call", call)


def lowered(monkeypatch, function, *args, assemblers=()):
    """Returns what XLA's compiler for NVIDIA GPUs gets, as text."""
    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "_assemblers", lambda: (assemblers, None))
    if not assemblers:
        monkeypatch.setattr(seam, "_handler", lambda kernel: seam._target(kernel.key))
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_grid", lambda items, most, blocks: (-(-items // 32), 32))
    traced = jax.jit(function).trace(*jax.tree.map(jnp.asarray, args))
    return traced.lower(lowering_platforms=("cuda",)).as_text()
