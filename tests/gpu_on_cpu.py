"""Runs kernels that are written for a GPU on this CPU, one thread after the other or several."""

import ctypes
import re
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engines.native import available
from mjx_reinforce.engines.native.cpu import machine
from mjx_reinforce.engines.native.gpu import player, ptx, seam


def as_for_a_cpu(text):
    """Returns a kernel's LLVM IR where every thread is a block of its own."""
    text = text.replace("define ptx_kernel void", "define void").replace(") #0 {", ") {")
    text = re.sub(r"attributes #0 = \{[^}]*\}", "", text)
    some = r'call i32 asm sideeffect "[^"]*barrier.red[^"]*", "=r,r"\(i32 (%\w+)\) convergent'
    text = re.sub(some, r"or i32 \1, 0", text)
    return re.sub(r'call void asm sideeffect "barrier[^\n]*', "", text)


def emulate(monkeypatch, threads=1):
    """Lets the native engine think that this is a GPU, whose kernels run so many threads."""

    def load(source, write, capability, folder):
        assert capability == "9.0"
        assert folder is None or folder.name == "native"
        text = as_for_a_cpu(write())
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
