"""LLVM's compiler: from text to object code, here or in a process of its own.

llvmlite lets one thread at a time into LLVM. So a long text is compiled by this file, run as a
program with the name of a machine: it reads the text, and writes object code.
"""

import atexit
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

Made = TypeVar("Made")
#: Those that compile now, and the threads that wait for them.
_PROCESSES: list[subprocess.Popen[bytes]] = []
_THREADS: list[threading.Thread] = []
#: Held while a process starts; none does once this one ends.
_STARTING, _ENDS = threading.Lock(), threading.Event()


def compiler(triple: str, cpu: str, features: str, effort: int) -> Any:
    """Returns LLVM's compiler for a machine; the effort is 0 to 3."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(triple).create_target_machine(
        cpu, features, opt=effort, reloc="pic", codemodel="small", jit=True
    )


def parse(text: str, target: Any) -> Any:
    """Returns the module of a text that names no target; RuntimeError if it is no LLVM IR."""
    import llvmlite.binding as llvm

    header = f'target datalayout = "{target.target_data}"\ntarget triple = "{target.triple}"\n'
    return llvm.parse_assembly(header + text)


def elsewhere(text: str, triple: str, cpu: str, features: str, effort: int) -> bytes | None:
    """Returns object code, compiled in a process of its own; None if that cannot compile.

    Raises:
      RuntimeError: the process was stopped, or this one ends.
    """
    command = [sys.executable, "-P", __file__, triple, cpu, features, str(effort)]
    pipe = subprocess.PIPE
    with _STARTING:
        if _ENDS.is_set():
            raise RuntimeError("this process ends")
        # In a session of its own: Ctrl-C asks a run to stop, which still needs its code for that.
        try:
            process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True
            )
        except OSError:  # such as no memory, or no Python there any more
            return None
        _PROCESSES.append(process)
    data, _ = process.communicate(text.encode())
    _PROCESSES.remove(process)
    if process.returncode < 0:
        raise RuntimeError(f"LLVM was stopped by signal {-process.returncode}")
    return None if process.returncode else data


def later(work: Callable[[], Made]) -> Future[Made]:
    """Returns what ``work`` will return, in a thread of its own."""
    made: Future[Made] = Future()

    def do() -> None:
        try:
            made.set_result(work())
        except BaseException as error:  # whatever it is, who waits gets it
            made.set_exception(error)

    thread = threading.Thread(target=do, daemon=True)
    _THREADS.append(thread)
    thread.start()
    return made


@atexit.register
def end_processes() -> None:
    """Ends LLVM's processes when this one ends; no other starts any more."""
    with _STARTING:
        _ENDS.set()
        for process in _PROCESSES:
            process.kill()
    for thread in _THREADS:
        thread.join()


def main() -> None:
    """Compiles standard input to standard output; the arguments are those of ``compiler``."""
    triple, cpu, features, effort = sys.argv[1:]
    target = compiler(triple, cpu, features, int(effort))
    made = target.emit_object(parse(sys.stdin.buffer.read().decode(), target))
    sys.stdout.buffer.write(made)


if __name__ == "__main__":
    main()
