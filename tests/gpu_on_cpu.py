"""Runs kernels that are written for a GPU on this CPU, one thread after the other or several."""

import ctypes
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engines.native import available
from mjx_reinforce.engines.native.cpu import machine
from mjx_reinforce.engines.native.gpu import player, ptx, seam

_SOME = re.compile(r'call i32 asm sideeffect "[^"]*bar.red[^"]*", "=r,r"\(i32 (%\w+)\) convergent')
_ALL = re.compile(r'call void asm sideeffect "[^"]*bar.sync[^\n]*')


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
    return block.text(text) if block else _ALL.sub("", _SOME.sub(r"or i32 \1, 0", text))


def emulate(monkeypatch, threads=1, block=None):
    """Lets the native engine think that this is a GPU, whose kernels run so many threads."""
    threads = block.threads if block else threads

    def load(source, write, capability, folder):
        assert capability == "9.0"
        assert folder is None or folder.name == "native"
        text = as_for_a_cpu(write(), block)
        code = machine.load(text, lambda: text, (player.ENTRY,), machine.this_machine(), None)
        return ptx.Kernel(code.key, str(code.addresses[player.ENTRY]), 128, compiled=True)

    def call(text, entry, results, grid, args):
        assert entry == player.ENTRY

        def run(*args):
            given = [np.array(x, order="C") for x in args]
            written = given[len(given) - len(results) :]
            assert not any(x.any() for x in written)
            pointers = [ctypes.c_void_p(x.ctypes.data) for x in [*given, *written]]
            play = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(pointers))(int(text))
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda _: play(*pointers), range(threads)))
            return written

        return jax.pure_callback(run, list(results), *args)

    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "unavailable", lambda: None)
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_grid", lambda items, most: (1, min(items, most)))
    monkeypatch.setattr(ptx, "load", load)
    monkeypatch.setattr(seam, "_call", call)


def lowered(monkeypatch, function, *args):
    """Returns what XLA's compiler for NVIDIA GPUs gets, as text."""
    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    monkeypatch.setattr(seam, "_grid", lambda items, most: (-(-items // 32), 32))
    traced = jax.jit(function).trace(*jax.tree.map(jnp.asarray, args))
    return traced.lower(lowering_platforms=("cuda",)).as_text()
