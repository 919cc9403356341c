"""Compilers: LLVM's, from text to object code, here or in a process of its own, and others'.

llvmlite lets one thread at a time into LLVM. So a long text is compiled by this file, run as a
program with the name of a machine: it reads the text, and writes object code.
"""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
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
    try:
        done = run(command, text.encode())
    except OSError:  # such as no memory, or no Python there any more
        return None
    if done.returncode < 0:
        raise RuntimeError(f"LLVM was stopped by signal {-done.returncode}")
    if done.returncode:
        return None
    return done.stdout


def run(command: Sequence[str], data: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """Runs a compiler in a process that ends with this one.

    Args:
      command: the program and its arguments.
      data: what it reads from standard input.

    Raises:
      OSError: it cannot start.
      RuntimeError: this process ends.
    """
    pipe = subprocess.PIPE
    with _START_LOCK:
        if _EXIT_EVENT.is_set():
            raise RuntimeError("this process ends")
        # In a session of its own: Ctrl-C asks a run to stop, which still needs its code for that.
        process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True
        )
        _PROCESSES.append(process)
    # Outside of the lock, which is held for a moment: this waits for minutes.
    stdout, stderr = process.communicate(data)
    _PROCESSES.remove(process)
    return subprocess.CompletedProcess(command, process.returncode, stdout, stderr)


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
def end_processes(seconds: float | None = None) -> None:
    """Ends the compilers' processes when this one ends; no other starts any more.

    Args:
      seconds: for which the threads that wait for them may take; by default what they take.
    """
    with _START_LOCK:
        _EXIT_EVENT.set()
        for process in _PROCESSES:
            _end(process)
    # Their processes are gone, so they return at once; none is left in LLVM while Python ends.
    for thread in _THREADS:
        thread.join(seconds)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ends a process and those that it has started, as a driver of compilers does."""
    if sys.platform == "win32":
        process.kill()
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def main() -> None:
    """Compiles standard input to standard output; arguments are those of ``target_machine``."""
    triple, cpu, features, effort = sys.argv[1:]
    target = target_machine(triple, cpu, features, int(effort))
    module = parse(sys.stdin.buffer.read().decode(), target)
    sys.stdout.buffer.write(target.emit_object(module))


if __name__ == "__main__":
    main()
