"""Machine code of the device code of teams, with one lane, by the C++ compiler of this system.

A text is a kernel as for a GPU; what is here makes of it ``@work`` of a handler in LLVM IR
(``handler.ll``), which the threads of a job call. Both objects become one, which is kept and
linked as any other.
"""

import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from mjx_reinforce.engine.cpu import emit, machine
from mjx_reinforce.engine.gpu.source import Source

#: What the compiler is told: as C, it may leave out that functions set errno.
_OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-w", "-fno-math-errno", "-fno-trapping-math")
_OPTIONS += ("-fno-exceptions", "-fno-rtti", "-fno-asynchronous-unwind-tables", "-fno-plt")
_TOOLS = Path(__file__).with_name("work.h")


@functools.cache
def compiler() -> str | None:
    """Returns the path of a C++ compiler; None where there is none."""
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@functools.cache
def version() -> str:
    """Returns what the compiler says that it is."""
    command = [str(compiler()), "--version"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def text_of(source: Source, work: str) -> str:
    """Returns the C++ of a kernel for one lane.

    Args:
      source: the kernel.
      work: the body of ``work``, which calls ``play``.
    """
    macros = "#define REAL float\n#define VECTORS 1\n"
    tools = _TOOLS.read_text("utf-8")
    # What C++ has on a GPU alone comes first.
    return f"{macros}{tools}{source.for_compiler()}\n{work}"


def play_work(num_inputs: int, num_results: int) -> str:
    """Returns the part of the C++ that plays; see ``loops.play_loop``.

    Args:
      num_inputs: arrays of the actor and the state.
      num_results: how many arrays ``play`` writes besides the number of the next item.
    """
    # The number of threads, of which ``play`` knows nothing, is behind the limits.
    inputs = [f"d[{k}]" for k in (0, *range(2, 3 + num_inputs))]
    zeros = ["Any{}"] * (num_results + 1)
    results = [f"d[{3 + num_inputs + k}]" for k in range(num_results)]
    arguments = ", ".join([*inputs, *zeros, *results])
    return (
        "CALLED work(Job* job) {\n"
        "  const int sizes[] = {int(job->total / job->episodes), int(job->episodes), "
        "int(job->horizon)};\n"
        "  const Any* d = job->data;\n"
        "  const Room<Word> room(size_t(THREAD_WORDS) * W + 1);\n"
        # The lower half of the number of the next item: there are fewer than 2^31.
        f"  play(sizes, {arguments}, reinterpret_cast<int*>(&job->next), room.item);\n"
        "}\n"
    )


def map_work(input_bytes: Sequence[int], result_bytes: Sequence[int]) -> str:
    """Returns the part of the C++ that maps; see ``loops.map_loop``.

    Args:
      input_bytes: of an example in each argument.
      result_bytes: of an example in each result.
    """
    rows = [*input_bytes, *result_bytes]
    arguments = ", ".join(f"d[{k}].from(k * {size}ll)" for k, size in enumerate(rows, start=1))
    return (
        "CALLED work(Job* job) {\n"
        "  const int sizes[] = {1};\n"
        "  const Any* d = job->data;\n"
        "  const Room<Word> room(size_t(THREAD_WORDS) * W + 1);\n"
        "  long long k;\n"
        "  while ((k = __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED)) < job->total)\n"
        f"    play(sizes, {arguments}, room.item);\n"
        "}\n"
    )


def compiled(text: str, handler: str, target: machine.Machine) -> bytes:
    """Returns the object of a text and its handler.

    Args:
      text: C++.
      handler: LLVM IR.
      target: what to compile for.

    Raises:
      RuntimeError: the compiler or the linker refuses it.
    """
    level = os.environ.get(machine.VARIABLE) or machine.HOST
    march = "native" if level == machine.HOST else level
    with tempfile.TemporaryDirectory() as folder:
        objects = [f"{folder}/work.o", f"{folder}/handler.o"]
        source = Path(folder, "work.cpp")
        source.write_text(text, "utf-8")
        _run([*_OPTIONS, f"-march={march}", "-c", str(source), "-o", objects[0]])
        llvm = emit.target_machine(target.triple, target.cpu, target.features, 2)
        Path(objects[1]).write_bytes(llvm.emit_object(emit.parse(handler, llvm)))
        _run(["-r", "-nostdlib", *objects, "-o", f"{folder}/both.o"])
        return Path(folder, "both.o").read_bytes()


def _run(arguments: Sequence[str]) -> None:
    """Runs the compiler."""
    done = subprocess.run(
        [str(compiler()), *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"the C++ compiler refuses a kernel: {done.stderr[:1000]}")
