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

Result = TypeVar("Result")
#: Those that compile now, and the threads that wait for them.
_PROCESSES: list[subprocess.Popen[bytes]] = []
_THREADS: list[threading.Thread] = []
#: Held while a process starts.
_START_LOCK = threading.Lock()
#: Set when this process ends: from then on none starts.
_EXIT_EVENT = threading.Event()


def target_machine(triple: str, cpu: str, features: str, effort: int) -> Any:
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
    # With -P this file's folder is not the first in which Python looks for modules.
    command = [sys.executable, "-P", __file__, triple, cpu, features, str(effort)]
    pipe = subprocess.PIPE
    with _START_LOCK:
        if _EXIT_EVENT.is_set():
            raise RuntimeError("this process ends")
        # In a session of its own: Ctrl-C asks a run to stop, which still needs its code for that.
        try:
            process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True
            )
        except OSError:  # such as no memory, or no Python there any more
            return None
        _PROCESSES.append(process)
    # Outside of the lock, which is held for a moment: this waits for minutes.
    data, _ = process.communicate(text.encode())
    _PROCESSES.remove(process)
    if process.returncode < 0:
        raise RuntimeError(f"LLVM was stopped by signal {-process.returncode}")
    if process.returncode:
        return None
    return data


def later(task: Callable[[], Result]) -> Future[Result]:
    """Returns what ``task`` will return, in a thread of its own."""
    future: Future[Result] = Future()

    def do() -> None:
        try:
            future.set_result(task())
        except BaseException as error:  # whatever it is, who waits gets it
            future.set_exception(error)

    thread = threading.Thread(target=do, daemon=True)
    _THREADS.append(thread)
    thread.start()
    return future


@atexit.register
def end_processes() -> None:
    """Ends LLVM's processes when this one ends; no other starts any more."""
    with _START_LOCK:
        _EXIT_EVENT.set()
        for process in _PROCESSES:
            process.kill()
    # Their processes are gone, so they return at once; none is left in LLVM while Python ends.
    for thread in _THREADS:
        thread.join()


def main() -> None:
    """Compiles standard input to standard output; arguments are those of ``target_machine``."""
    triple, cpu, features, effort = sys.argv[1:]
    target = target_machine(triple, cpu, features, int(effort))
    module = parse(sys.stdin.buffer.read().decode(), target)
    sys.stdout.buffer.write(target.emit_object(module))


if __name__ == "__main__":
    main()
