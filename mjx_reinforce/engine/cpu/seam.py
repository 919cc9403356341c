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

_WAITING_HANDLER = Path(__file__).with_name("waiting.ll")
#: The keys of the code whose handler XLA has.
_HANDLER_KEYS: set[str] = set()


def call(
    code: Code, shapes: Sequence[jax.ShapeDtypeStruct], *args: jax.Array
) -> Sequence[jax.Array]:
    """Calls machine code under any transformation but differentiation.

    Args:
      code: a function of ``handler.SYMBOLS``.
      shapes: shapes and dtypes of what it returns, as ``handler.handler_text`` says.
      args: arrays, as ``handler.handler_text`` says; vmapped, all get the new axis in front.
    """
    register(code)
    return jax.ffi.ffi_call(_target(code.key), shapes, vmap_method="broadcast_all")(*args)


def register(code: Code) -> None:
    """Tells XLA where the handler is, once.

    Raises:
      RuntimeError: XLA does not take it.
    """
    if code.key in _HANDLER_KEYS:
        return
    jax.devices()  # a handler refused before XLA has started would keep it from starting
    # XLA keeps the first address that it gets; of code that is still compiled that of a handler
    # which waits for it, and says where it was not compiled.
    future = code.future_addresses
    is_compiled = future.done() and not future.exception()
    address = code.addresses["handler"] if is_compiled else _waiting_handler(code)
    capsule = jax.ffi.pycapsule(ctypes.c_void_p(address))
    jax.ffi.register_ffi_target(_target(code.key), capsule, platform="cpu")
    _HANDLER_KEYS.add(code.key)


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
        code = machine.loaded(name.decode(), handler.SYMBOLS, folder) if folder else None
        if code is None:
            return False
        register(code)
    return True


def _target(key: str) -> str:
    """Returns XLA's name of the handler; programs in JAX's cache find it again by it."""
    return f"mjx_reinforce_{key}"


def _waiting_handler(code: Code) -> int:
    """Returns a handler that waits for that of code which is still compiled, and calls it.

    XLA compiles the program around it meanwhile.
    """
    text = f"; waits for {code.key}\n{handler.with_entry(_WAITING_HANDLER, {})}"
    functions = ("handler", "slot", "failed")
    target = machine.this_machine()
    # A short text is compiled at once, so these addresses need no waiting.
    addresses = machine.load_module(text, lambda: text, functions, target, None).addresses

    def fill_slot(future: Future[dict[str, int]]) -> None:
        address = addresses["failed"] if future.exception() else future.result()["handler"]
        # The waiting handler loads the slot atomically, and an aligned pointer is stored at once.
        ctypes.c_void_p.from_address(addresses["slot"]).value = address

    code.future_addresses.add_done_callback(fill_slot)
    # At exit the last registered function is called first: so this is before JAX ends, which waits
    # for running programs, and these for their code.
    atexit.register(emit.end_processes)
    return addresses["handler"]
