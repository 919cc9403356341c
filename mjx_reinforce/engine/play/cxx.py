"""Machine code by this system's C++ compiler: kernels of teams of one lane, on a CPU.

A text is C++ and, behind it, the handler that calls it (``handler.py``), in LLVM IR. Both objects
become one, which is kept and linked as any other.
"""

import functools
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import jax
import numpy as np

from mjx_reinforce.engine.cpu import emit, handler, kernel, machine
from mjx_reinforce.engine.gpu.loops import RESULTS
from mjx_reinforce.engine.gpu.source import Source
from mjx_reinforce.engine.scalar import UnsupportedPrimitive, scalarized

#: No function sets errno, and nothing unwinds the stack.
_OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-w", "-fno-math-errno", "-fno-trapping-math")
_OPTIONS += ("-fno-exceptions", "-fno-rtti", "-fno-asynchronous-unwind-tables", "-fno-plt")
_MACROS = "#define REAL float\n#define VECTORS 1\n"
_WORK = Path(__file__).with_name("work.h")
#: Between the C++ and the handler.
_BORDER = "// The handler, in LLVM IR.\n"
#: A kernel's arguments behind the arrays of a step: keys, t and whether it is deterministic.
_NUM_OTHERS = 3
_NUM_RECORDS = kernel.NUM_RECORDS


@functools.cache
def compiler() -> str | None:
    """Returns the path of a C++ compiler that makes kernels here; None where there is none."""
    for name in ("c++", "g++", "clang++"):
        path = shutil.which(name)
        if path is not None:
            try:
                with tempfile.TemporaryDirectory() as folder:
                    example = _object(path, 'extern "C" int one() { return 1; }', Path(folder))
                    _join(path, [example], Path(folder))
            except (OSError, UnsupportedPrimitive):
                continue
            return path
    return None


@functools.cache
def version() -> str:
    """Returns what the compiler says that it is."""
    return emit.run([str(compiler()), "--version"]).stdout.decode(errors="replace")


def player_text(program: scalarized.Scalarized, source: Source) -> str:
    """Returns the text of a kernel that plays.

    Its arguments and results are those of ``handler.handler_text``, but that its records are
    observation [*B, T, O, N], action [*B, T, A, N] and reward [*B, T, (1 + K) N].

    Args:
      program: a step, written out.
      source: the kernel, of ``loops.play_loop``.
    """
    num_inputs = len(_filled(program.in_avals)) - _NUM_OTHERS
    first_result = kernel.NUM_CONTROLS + num_inputs
    # The number of threads, of which the kernel knows nothing, is behind the limits.
    inputs = [handler.LIMITS, *range(handler.KEYS, first_result)]
    # It writes the results in place, which are zero: what it does not read of them has no place.
    # The item to be fetched next, the last result, is the job's.
    results = [*range(first_result, first_result + len(RESULTS) - 1)]
    places = [f"buffers[{k}]" for k in inputs] + ["Buffer{}"] * len(RESULTS)
    places += [f"buffers[{k}]" for k in results]
    calls = f"""
    const int sizes[] = {{int(job->total / job->episodes), int(job->episodes), int(job->horizon)}};
    play(sizes, {", ".join(places)}, reinterpret_cast<int*>(&job->next), room.item);"""
    sizes = [np.dtype(x.dtype).itemsize for x in program.out_avals[:_NUM_RECORDS]]
    return _text(source, calls, handler.handler_text(first_result, [*sizes, 4, 4, 4]))


def mapping_text(program: scalarized.Scalarized, source: Source) -> str:
    """Returns the text of a kernel that maps; its arguments are as of ``kernel.mapping_text``.

    Args:
      program: the function, written out.
      source: the kernel, of ``loops.map_loop``.
    """
    inputs, results = _filled(program.in_avals), _filled(program.out_avals)
    places = [
        f"buffers[{number}].behind(k * {x.size * np.dtype(x.dtype).itemsize})"
        for number, x in enumerate([*inputs, *results], start=1)
    ]
    calls = f"""
    const int sizes[] = {{1}};
    long long k;
    while ((k = __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED)) < job->total)
      play(sizes, {", ".join(places)}, room.item);"""
    sizes = [np.dtype(x.dtype).itemsize for x in results]
    entry = handler.handler_text(1 + len(inputs), sizes, positions=kernel.MAPPING, is_zeroed=False)
    return _text(source, calls, entry)


def _filled(avals: Iterable[jax.ShapeDtypeStruct]) -> list[jax.ShapeDtypeStruct]:
    """Returns the arrays that are not empty: XLA passes no others."""
    return [x for x in avals if np.prod(x.shape)]


def _text(source: Source, calls: str, entry: str) -> str:
    """Returns a text.

    Args:
      source: a kernel.
      calls: the lines that call it, of a job.
      entry: the handler.
    """
    work = _WORK.read_text("utf-8").replace("// calls\n", f"{calls}\n")
    head, _, tail = work.partition("// The kernel.\n")
    flush = handler.flush(machine.this_machine().triple)
    return f"{head}{_MACROS}{source.for_compiler()}\n{tail}{_BORDER}{entry}{flush}{_WORK_IR}"


#: What a thread of a job does.
_WORK_IR = """
declare void @work_here(ptr)
define void @work(ptr %job) {
  %control = call i64 @flush()
  call void @work_here(ptr %job)
  call void @unflush(i64 %control)
  ret void
}
"""


def check(text: str) -> None:
    """Checks that the compiler takes a text, before any code is made of it.

    Raises:
      UnsupportedPrimitive: the compiler refuses it.
    """
    program, _, _ = text.partition(_BORDER)
    with tempfile.TemporaryDirectory() as folder:
        _run(str(compiler()), [*_options(), "-fsyntax-only", str(_written(program, Path(folder)))])


def compiled(text: str, target: machine.Machine) -> bytes:
    """Returns the object of a text.

    Raises:
      UnsupportedPrimitive: the compiler refuses it.
    """
    program, _, entry = text.partition(_BORDER)
    path = str(compiler())
    with tempfile.TemporaryDirectory() as folder:
        kernel_object = _object(path, program, Path(folder))
        llvm = emit.target_machine(target.triple, target.cpu, target.features, 2)
        handler_object = Path(folder, "handler.o")
        handler_object.write_bytes(llvm.emit_object(emit.parse(entry, llvm)))
        return _join(path, [kernel_object, handler_object], Path(folder)).read_bytes()


def _join(path: str, parts: Sequence[Path], folder: Path) -> Path:
    """Returns where one object of several is, in a folder."""
    joint_object = folder / "joint.o"
    # Relocatable, no library: LLVM puts it into memory.
    _run(path, ["-r", "-nostdlib", "-o", str(joint_object), *map(str, parts)])
    return joint_object


def _object(path: str, program: str, folder: Path) -> Path:
    """Returns where the object of a C++ program is, in a folder; see ``compiled``."""
    place = folder / "kernel.o"
    _run(path, [*_options(), "-c", str(_written(program, folder)), "-o", str(place)])
    return place


def _written(program: str, folder: Path) -> Path:
    """Writes a C++ program into a folder; returns where."""
    source = folder / "kernel.cpp"
    source.write_text(program, "utf-8")
    return source


def _options() -> tuple[str, ...]:
    """Returns the compiler's options for this machine."""
    level = machine.asked_level()
    return (*_OPTIONS, f"-march={'native' if level == machine.HOST else level}")


def _run(path: str, arguments: Sequence[str]) -> None:
    """Runs a compiler."""
    done = emit.run([path, *arguments])
    if done.returncode:
        lines = done.stderr.decode(errors="replace").splitlines() or [f"exit {done.returncode}"]
        # The first error, without the place in a file that is gone.
        message = next((x for x in lines if "error: " in x), lines[0]).rpartition("error: ")[2]
        raise UnsupportedPrimitive(f"the C++ compiler {path} refuses it: {message[:200]}")
