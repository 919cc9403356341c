"""From LLVM IR to functions in memory, for the CPU of this machine.

The object code is position independent in the small code model, so that constants are operands of
instructions: such code runs 1.2 to 2 times as fast as that of LLVM's default for JITs. JITLink
lays each object out in one piece, which that model asks for.
"""

import functools
import itertools
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.engine.cpu import emit

#: Asks for code that older CPUs run too; one of ``LEVELS``.
VARIABLE = "MJX_REINFORCE_CPU"
#: All that the CPU has, whatever the variable says.
HOST = "host"
#: The levels of x86-64: float32 values in a vector register, what a CPU has beyond the last level.
LEVELS = {
    "x86-64": (4, ()),
    "x86-64-v2": (4, ("sse3", "ssse3", "sse4.1", "sse4.2", "popcnt")),
    "x86-64-v3": (8, ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")),
    "x86-64-v4": (16, ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")),
}
#: LLVM holds vectors of 512 bits back where they lower the clock; the lanes are worth more.
_WIDTH = "-prefer-256-bit"
#: Characters of a text that LLVM compiles with less effort, and in a process of its own.
_LONG_TEXT = 2_000_000
_CACHE: dict[str, "Code"] = {}
_LOCK = threading.Lock()
#: Makes the names of libraries different.
_LIBRARY_NUMBERS = itertools.count()


class Machine(NamedTuple):
    """What code is made for.

    triple: architecture, system and object format
    cpu: LLVM's name
    features: LLVM's list, such as "+avx2,-avx512f", beyond what the name says
    lanes: float32 values in a vector register; of float64 half as many
    """

    triple: str
    cpu: str
    features: str
    lanes: int


class Code(NamedTuple):
    """Functions in memory. They stay until the process ends: other threads may still run them.

    key: a name for all that the code depends on
    future_addresses: function -> where it is, once they are in memory
    compiled: whether it was compiled now, and not read from disk
    """

    key: str
    future_addresses: Future[dict[str, int]]
    compiled: bool

    @property
    def addresses(self) -> dict[str, int]:
        """Returns where the functions are; waits until they are in memory."""
        return self.future_addresses.result()


def asked_level() -> str:
    """Returns what the variable asks for: one of ``LEVELS``, or ``HOST`` if it is not set.

    Raises:
      ValueError: it is none of these.
    """
    level = os.environ.get(VARIABLE) or HOST
    check_name(VARIABLE, level, {HOST: None, **LEVELS})
    return level


def this_machine(level: str | None = None) -> Machine:
    """Returns this machine, or it at an older level of x86-64.

    Args:
      level: one of ``LEVELS``, or ``HOST`` for all that the CPU has; by default what the variable
      MJX_REINFORCE_CPU says, else ``HOST``.

    Raises:
      ValueError: the level is unknown, or this CPU is below it.
    """
    import llvmlite.binding as llvm

    level = level or asked_level()
    triple = llvm.get_process_triple()
    try:
        features = llvm.get_host_cpu_features()
    except RuntimeError:  # where LLVM cannot ask, as on some ARM systems, the name says it
        features = llvm.targets.FeatureMap()
    if level != HOST:
        lanes = _check_level(level, triple, features)
        return Machine(triple, level, _WIDTH if lanes == 16 else "", lanes)
    if features.get("avx512f"):
        return Machine(triple, llvm.get_host_cpu_name(), f"{features.flatten()},{_WIDTH}", 16)
    # Without AVX that of SSE, or of NEON: 128 bits.
    lanes = 8 if features.get("avx") else 4
    return Machine(triple, llvm.get_host_cpu_name(), features.flatten(), lanes)


def _check_level(level: str, triple: str, features: dict[str, bool]) -> int:
    """Returns the lanes of a level; ValueError if this CPU is below it."""
    # A level has the features of all levels before it, too.
    levels = list(LEVELS)
    required = [f for name in levels[: levels.index(level) + 1] for f in LEVELS[name][1]]
    absent = [feature for feature in required if not features.get(feature)]
    if not triple.startswith("x86_64"):
        absent = [f"this is {triple.partition('-')[0]}"]
    if absent:
        raise ValueError(
            f"{VARIABLE} asks for {level!r}, which this CPU is not: no {', '.join(absent)}; "
            "unset it"
        )
    return LEVELS[level][0]


def load_module(
    source: str,
    write: Callable[[], str],
    functions: tuple[str, ...],
    machine: Machine,
    folder: Path | None,
    compile: Callable[[str, Machine], bytes] | None = None,
) -> Code:
    """Returns the functions of a module, compiled unless memory or disk has them.

    A long text is compiled in a process of its own; its functions are in memory later.

    Args:
      source: all that the module's text depends on, or a hash of it.
      write: returns the text, LLVM IR without a target. It may call functions of the C library.
      functions: the functions to be found in ``addresses``.
      machine: what to compile for.
      folder: where compiled objects are kept; None keeps none.
      compile: returns the object of a text that is no LLVM IR, and is another compiler's.

    Raises:
      RuntimeError: the text is no LLVM IR, or it calls a function that is nowhere; a long text's
        ``addresses`` raise the latter.
    """
    key = objects.key_of(*machine, *functions, source)
    with _LOCK:
        if key not in _CACHE:
            object_code = objects.kept(key, folder)
            if object_code:
                future = _done(_link(key, functions, object_code))
            else:
                future = _make(key, write(), functions, machine, folder, compile)
            _CACHE[key] = Code(key, future, compiled=not object_code)
        return _CACHE[key]


def _make(
    key: str,
    text: str,
    functions: tuple[str, ...],
    machine: Machine,
    folder: Path | None,
    compile: Callable[[str, Machine], bytes] | None,
) -> Future[dict[str, int]]:
    """Returns where the functions of a module will be."""

    def finish(compile: Callable[[str, Machine], bytes]) -> dict[str, int]:
        data = objects.make(key, folder, text, lambda text: compile(text, machine))
        return _link(key, functions, data)

    if compile:
        return emit.later(lambda: finish(compile))
    # A program without Python's own executable, as one that embeds it, has no other process.
    if len(text) <= _LONG_TEXT or not sys.executable:
        return _done(finish(_compile))
    emit.parse(text, _target(machine))  # what is no LLVM IR is known at once
    return emit.later(lambda: finish(_compile_elsewhere))


def _done(addresses: dict[str, int]) -> Future[dict[str, int]]:
    future: Future[dict[str, int]] = Future()
    future.set_result(addresses)
    return future


def in_memory() -> list[str]:
    """Returns the keys of all code in memory."""
    return list(_CACHE)


def loaded(key: str, functions: tuple[str, ...], folder: Path) -> Code | None:
    """Returns the functions of a module by the key of their ``Code``; None if it is not on disk."""
    with _LOCK:
        if key not in _CACHE:
            data = objects.read_object(folder, key)
            if data is None:
                return None
            _CACHE[key] = Code(key, _done(_link(key, functions, data)), compiled=False)
        return _CACHE[key]


def _compile(text: str, machine: Machine) -> bytes:
    """Returns object code of a text."""
    target = _target(machine, _effort(text))
    return target.emit_object(emit.parse(text, target))


def _compile_elsewhere(text: str, machine: Machine) -> bytes:
    """Returns object code of a text; this process compiles where no other can."""
    effort = _effort(text)
    data = emit.elsewhere(text, machine.triple, machine.cpu, machine.features, effort)
    return data or _compile(text, machine)


def _effort(text: str) -> int:
    """Returns LLVM's level of effort for a text.

    A long program compiles in two thirds of the time with less effort, and runs as fast (Ant,
    Humanoid); a short one may run slower (Hopper: 4%).
    """
    return 1 if len(text) > _LONG_TEXT else 2


def _target(machine: Machine, effort: int = 2) -> Any:
    """Returns LLVM's compiler for a machine."""
    return emit.target_machine(machine.triple, machine.cpu, machine.features, effort)


def _link(key: str, functions: tuple[str, ...], data: bytes) -> dict[str, int]:
    """Puts object code into memory for good; returns where its functions are."""
    import llvmlite.binding as llvm

    builder = llvm.JITLibraryBuilder().add_object_img(data).add_current_process()
    for name in functions:
        builder.export_symbol(name)
    library = builder.link(_linker(), f"{key}.{next(_LIBRARY_NUMBERS)}")
    addresses = {name: library[name] for name in functions}
    # Its code would be unloaded with the Python object, while threads of XLA may still run it.
    library.detach()
    return addresses


@functools.cache
def _linker() -> Any:
    """Returns the linker of this process, which is never closed."""
    import llvmlite.binding as llvm

    return llvm.create_lljit_compiler(_target(this_machine()), use_jit_link=True)
