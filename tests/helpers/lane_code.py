"""Machine code over arrays, called from Python: a loop over vectors of lanes."""

import ctypes

import numpy as np

from mjx_reinforce.engine.llvm.text import Text

BYTE, BOOL = np.dtype(np.int8), np.dtype(np.bool_)


def target_machine(cpu=None):
    """The host, or a processor of its family that can do less; an engine takes it."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten() if cpu is None else ""
    target = llvm.Target.from_default_triple()
    cpu = cpu or llvm.get_host_cpu_name()
    return target.create_target_machine(cpu=cpu, features=features, opt=2, jit=True)


def parse(text, num_operands):
    """Returns a module with the function ``f`` of pointers to operands and result, and a size."""
    import llvmlite.binding as llvm

    pointers = ", ".join(f"ptr %in{i}" for i in range(num_operands))
    module = llvm.parse_assembly(text.function(f"void @f({pointers}, ptr %out, i64 %size)"))
    module.verify()
    return module


def stored(dtype):
    """Returns what is in memory: bools are bytes there, and bits in a vector."""
    return BYTE if dtype == BOOL else dtype


def engine(write, kinds, dtype, lanes, cpu=None):
    """Returns compiled code of what ``write(text, names)`` makes of vectors of some kinds."""
    import llvmlite.binding as llvm

    text = Text(lanes)
    text.line("br label %loop")
    text.start("loop")
    at = text.let("phi i64 [0, %start], [%next, %more]")

    def place(array, kind):
        size = stored(kind).itemsize
        first = text.let(f"mul i64 {at}, {size}")
        return f"ptr {text.let(f'getelementptr i8, ptr {array}, i64 {first}')}, align {size}"

    names = []
    for i, kind in enumerate(kinds):
        name = text.let(f"load {text.type(stored(kind))}, {place(f'%in{i}', kind)}")
        bits = f"trunc {text.type(BYTE)} {name} to {text.type(kind)}"
        names.append(text.let(bits) if kind == BOOL else name)
    result = write(text, names)
    if dtype == BOOL:
        result = text.let(f"zext {text.type(dtype)} {result} to {text.type(BYTE)}")
    text.line(f"store {text.type(stored(dtype))} {result}, {place('%out', dtype)}")
    text.line("br label %more")
    text.start("more")
    text.line(f"%next = add i64 {at}, {lanes}")
    text.line("%again = icmp ult i64 %next, %size")
    text.line("br i1 %again, label %loop, label %end")
    text.start("end")
    text.line("ret void")
    compiled = llvm.create_mcjit_compiler(parse(text, len(kinds)), target_machine(cpu))
    compiled.finalize_object()
    return compiled


def call(compiled, operands, out):
    """Calls such code with arrays of so many vectors; returns ``out``, its result."""
    arrays = [*map(np.ascontiguousarray, operands), out]
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arrays), ctypes.c_int64)
    kind(compiled.get_function_address("f"))(*(x.ctypes.data for x in arrays), out.size)
    return out
