"""What is known of each kernel, for work on the compiler: the variable MJX_REINFORCE_DEBUG.

With 1, each kernel that is built is described on stderr. With 2, its texts are left beside the kept
objects too. While the variable is set, a kernel is built even if the disk has it.
"""

import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from mjx_reinforce.engines.native.ownership import make_folder

Compiled = TypeVar("Compiled", str, bytes)
#: Asks for descriptions; see ``level``.
DEBUG = "MJX_REINFORCE_DEBUG"
#: What NVIDIA's assembler says of a function, of which a kernel may have several.
_LOG = {
    "registers of a thread": (r"Used (\d+) registers", max, ""),
    "local memory of a thread": (r"(\d+) bytes (?:stack frame|cumulative stack)", max, " bytes"),
    "spill stores": (r"(\d+) bytes spill stores", sum, " bytes"),
    "spill loads": (r"(\d+) bytes spill loads", sum, " bytes"),
    "shared memory of a block": (r"(\d+) bytes smem", max, " bytes"),
}
#: x86-64: the stack pointer is aligned for vectors and then lowered, by so many bytes.
_FRAME = re.compile(rb"\x48\x83\xe4.\x48\x81\xec(.{4})", re.DOTALL)


def level() -> int:
    """Returns 0 for nothing, 1 for descriptions of kernels, 2 for their texts too.

    Raises:
      ValueError: the variable has another value.
    """
    value = os.environ.get(DEBUG) or "0"
    if value not in ("0", "1", "2"):
        raise ValueError(
            f"{DEBUG} is {value!r}; set it to 1 for a description of each kernel, to 2 for its "
            "text too, or unset it"
        )
    return int(value)


def say(text: str) -> None:
    """Prints a line on stderr where descriptions are asked for."""
    if level():
        print(" ".join(text.split()), file=sys.stderr, flush=True)


def title(what: str, operations: int) -> str:
    """Returns a comment in LLVM IR: what the kernel plays or maps, and its scalar operations."""
    return f"; {what}, {operations:,} scalar operations\n"


def name_of(env: Any) -> str:
    """Returns the class of an environment, and of those in it if it wraps one."""
    inner = getattr(env, "env", None)
    return type(env).__name__ + ("" if inner is None else f" of {name_of(inner)}")


def build(
    key: str,
    folder: Path | None,
    write: Callable[[], str],
    compile: Callable[[str], Compiled],
    facts: Callable[[Compiled], Mapping[str, str]],
    texts: Callable[[str, Compiled], Mapping[str, str]],
) -> Compiled:
    """Returns what ``compile`` makes of what ``write`` returns, and describes it if asked to.

    Args:
      key: the name of the kernel.
      folder: where its texts are left; None where nothing is kept.
      write: traces, and returns LLVM IR that begins with ``title``.
      compile: returns PTX or object code.
      facts: what was made -> what else is known of it.
      texts: LLVM IR, what was made -> file ending -> text.
    """
    wanted = level()
    if not wanted:
        return compile(write())
    began = time.perf_counter()
    text = write()
    written = time.perf_counter()
    made = compile(text)
    compiled = time.perf_counter()
    lines = {
        "tracing and writing out": f"{written - began:.2f} s",
        "LLVM": f"{compiled - written:.2f} s",
        **_or_why("figures", lambda: facts(made)),
    }
    if wanted == 2:
        lines |= _or_why("texts", lambda: _leave(folder, key, texts(text, made)))
    about = text.partition("\n")[0].removeprefix("; ")
    said = [f"kernel {key}: {about}", *(f"  {name}: {value}" for name, value in lines.items())]
    print("\n".join(said), file=sys.stderr, flush=True)
    return made


def _or_why(what: str, found: Callable[[], Mapping[str, str]]) -> Mapping[str, str]:
    """Returns what is found, or why it is not: a description breaks no run."""
    try:
        return found()
    except Exception as error:  # whatever a driver, a library or a disk raises
        return {f"no {what}": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}


def _leave(folder: Path | None, key: str, texts: Mapping[str, str]) -> dict[str, str]:
    """Writes the texts of a kernel; returns where they are."""
    if folder is None:
        raise OSError("no folder for the texts: JAX keeps no programs on disk")
    make_folder(folder)
    for ending, text in texts.items():
        (folder / f"{key}.{ending}").write_text(text, encoding="utf-8")
    return {f"text, {ending}": str(folder / f"{key}.{ending}") for ending in texts}


def code_facts(data: bytes) -> dict[str, str]:
    """Returns what is known of an object file: bytes of code, and on x86-64 of a stack frame."""
    frames = [int.from_bytes(found, "little") for found in _FRAME.findall(data)]
    stack = {"stack of a thread": f"{max(frames):,} bytes"} if frames else {}
    return {"machine code": f"{_text_bytes(data):,} bytes", **stack}


def _text_bytes(data: bytes) -> int:
    import llvmlite.binding as llvm

    return sum(x.size() for x in llvm.ObjectFileRef.from_data(data).sections() if x.is_text())


def log_facts(log: str) -> dict[str, str]:
    """Returns what the log of NVIDIA's assembler says of a kernel."""
    found = {name: list(map(int, re.findall(x[0], log))) for name, x in _LOG.items()}
    if not found["registers of a thread"]:
        return {"the driver's log": " ".join(log.split())[:300] or "empty"}
    return {name: f"{x[1](found[name] or [0]):,}{x[2]}" for name, x in _LOG.items()}
