"""How JAX calls machine code on a CPU; here and in the GPU's ``seam`` alone stands ``jax.ffi``.

XLA's CPU runtime calls the handler itself, within compiled programs and loops, without Python.
"""

import atexit
import ctypes
import re
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import jax

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import emit, handler, machine
from mjx_reinforce.engine.cpu.machine import Code

_WAITING = Path(__file__).with_name("waiting.ll")
#: The keys of the code that XLA knows.
_KNOWN: set[str] = set()


def call(
    code: Code, results: Sequence[jax.ShapeDtypeStruct], *args: jax.Array
) -> Sequence[jax.Array]:
    """Calls machine code under any transformation but differentiation.

    Args:
      code: a function of ``handler.NAMES``.
      results: shapes and dtypes of what it returns, as ``handler.handler_text`` says.
      args: arrays, as ``handler.handler_text`` says; vmapped, all get the new axis in front.
    """
    register(code)
    return jax.ffi.ffi_call(_target(code.key), results, vmap_method="broadcast_all")(*args)


def register(code: Code) -> None:
    """Tells XLA where the handler is, once.

    Raises:
      RuntimeError: XLA does not take it.
    """
    if code.key in _KNOWN:
        return
    jax.devices()  # a handler refused before XLA has started would keep it from starting
    address = ctypes.c_void_p(code.addresses["handler"] if code.made.done() else _waiting(code))
    jax.ffi.register_ffi_target(_target(code.key), jax.ffi.pycapsule(address), platform="cpu")
    _KNOWN.add(code.key)


def targets() -> list[str]:
    """Returns XLA's names of all handlers that there are in memory."""
    return [_target(key) for key in machine.in_memory()]


def restore(program: bytes) -> bool:
    """Makes ready the machine code that a program calls, from disk; returns whether all is there.

    Args:
      program: as JAX exports it, or anything else that has the names of handlers in it.
    """
    folder = objects.folder()
    for name in set(re.findall(rb"mjx_reinforce_([0-9a-f]{64})", program)):
        code = machine.loaded(name.decode(), handler.NAMES, folder) if folder else None
        if code is None:
            return False
        register(code)
    return True


def _target(key: str) -> str:
    """Returns XLA's name of the handler; programs in JAX's cache find it again by it."""
    return f"mjx_reinforce_{key}"


def _waiting(code: Code) -> int:
    """Returns a handler that waits for that of code which is still compiled, and calls it.

    XLA compiles the program around it meanwhile.
    """
    text = f"; waits for {code.key}\n{handler.with_entry(_WAITING, {})}"
    names, target = ("handler", "slot", "failed"), machine.this_machine()
    found = machine.load_module(text, lambda: text, names, target, None).addresses

    def fill(made: Future[dict[str, int]]) -> None:
        ready = found["failed"] if made.exception() else made.result()["handler"]
        ctypes.c_void_p.from_address(found["slot"]).value = ready

    code.made.add_done_callback(fill)
    atexit.register(emit.end_processes)  # before JAX ends, which waits for running programs
    return found["handler"]
