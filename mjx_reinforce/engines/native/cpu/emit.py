"""LLVM's compiler: from text to object code, here or in a process of its own.

llvmlite lets one thread at a time into LLVM. So a long text is compiled by this file, run as a
program with the name of a machine: it reads the text, and writes object code.
"""

import sys
from typing import Any


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


def main() -> None:
    """Compiles standard input to standard output; the arguments are those of ``compiler``."""
    triple, cpu, features, effort = sys.argv[1:]
    target = compiler(triple, cpu, features, int(effort))
    made = target.emit_object(parse(sys.stdin.buffer.read().decode(), target))
    sys.stdout.buffer.write(made)


if __name__ == "__main__":
    main()
