"""How LLVM IR computes each operation of the scalar graph, lane by lane."""

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_reinforce.fused.backends import llvm_math
from mjx_reinforce.fused.backends.llvm_text import Text, scalar_type
from mjx_reinforce.fused.errors import UnsupportedPrimitive
from mjx_reinforce.fused.ops import FACTS, Op

#: (text, operation, dtype of the result, dtypes of the operands, operands) -> result
Emit = Callable[[Text, Op, np.dtype, list[np.dtype], list[str]], str]

_ORDERED = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}


def is_constant_text(operand: str) -> bool:
    """Returns whether an operand's text is a constant."""
    return not operand.startswith("%")


def _binary(on_floats: str, on_integers: str) -> Emit:
    """An instruction of two operands. ``contract`` lets a product and a sum become one."""

    def emit(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
        instruction = f"{on_floats} contract" if dtype.kind == "f" else on_integers
        return text.let(f"{instruction} {text.type(dtype)} {args[0]}, {args[1]}")

    return emit


def _compare(text: Text, op: Op, _: np.dtype, kinds: list[np.dtype], args: list[str]) -> str:
    kind = kinds[0].kind
    if kind == "f":
        return text.let(f"fcmp {_ORDERED[op.name]} {text.type(kinds[0])} {args[0]}, {args[1]}")
    sign = "" if op.name in ("eq", "ne") else "s" if kind == "i" else "u"
    return text.let(f"icmp {sign}{op.name} {text.type(kinds[0])} {args[0]}, {args[1]}")


def _write_extreme(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    """The greater or the lesser; NaN where either is NaN."""
    kind = text.type(dtype)
    if dtype == np.bool_:
        return text.let(f"{'or' if op.name == 'max' else 'and'} {kind} {args[0]}, {args[1]}")
    if dtype.kind != "f":
        sign = "s" if dtype.kind == "i" else "u"
        return text.call(f"llvm.{sign}{op.name}", dtype, *args)
    if is_constant_text(args[0]):  # a constant is not NaN, and one comparison is enough
        args = args[::-1]
    order = "gt" if op.name == "max" else "lt"
    if is_constant_text(args[1]):
        first = text.let(f"fcmp u{order} {kind} {args[0]}, {args[1]}")
    else:
        greater = text.let(f"fcmp o{order} {kind} {args[0]}, {args[1]}")
        missing = text.let(f"fcmp uno {kind} {args[0]}, {args[0]}")
        first = text.let(f"or {text.type(bool)} {greater}, {missing}")
    return text.let(f"select {text.type(bool)} {first}, {kind} {args[0]}, {kind} {args[1]}")


def _write_select(
    text: Text, op: Op, dtype: np.dtype, kinds: list[np.dtype], args: list[str]
) -> str:
    """Picks the case that the first operand numbers."""
    which, *cases = args
    kind = text.type(dtype)
    chosen = cases[0]
    for number, case in enumerate(cases[1:], start=1):
        mask = which
        if kinds[0] != np.bool_:
            at = text.constant(kinds[0].type(number))
            mask = text.let(f"icmp sge {text.type(kinds[0])} {which}, {at}")
        chosen = text.let(f"select {text.type(bool)} {mask}, {kind} {case}, {kind} {chosen}")
    return chosen


def _write_division(
    text: Text, op: Op, dtype: np.dtype, kinds: list[np.dtype], args: list[str]
) -> str:
    """Division or its rest; by an integer zero as XLA does it: -1, or the dividend.

    A processor stops the program where it divides by an integer zero, or the least one by -1.
    """
    kind = text.type(dtype)
    if dtype.kind == "f":
        instruction = "fdiv contract" if op.name == "div" else "frem"
        return text.let(f"{instruction} {kind} {args[0]}, {args[1]}")
    instruction = ("s" if dtype.kind == "i" else "u") + op.name
    zero, one, ones = (text.constant(x) for x in (dtype.type(0), dtype.type(1), ~dtype.type(0)))

    def by(number: str, chosen: str, otherwise: str) -> str:
        here = text.let(f"icmp eq {kind} {args[1]}, {number}")
        return text.let(f"select {text.type(bool)} {here}, {kind} {chosen}, {kind} {otherwise}")

    divisor = by(zero, one, args[1])
    if dtype.kind == "i":
        divisor = by(ones, one, divisor)
    result = text.let(f"{instruction} {kind} {args[0]}, {divisor}")
    if dtype.kind == "i" and op.name == "div":
        result = by(ones, text.let(f"sub {kind} {zero}, {args[0]}"), result)
    return by(zero, ones if op.name == "div" else args[0], result)


def _shift(instruction: str) -> Emit:
    """A shift; by as many bits as there are, or more, nothing is left but copies of the sign."""

    def emit(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
        kind, bits = text.type(dtype), dtype.itemsize * 8
        last = text.constant(dtype.type(bits - 1))
        inside = text.let(f"icmp ule {kind} {args[1]}, {last}")
        by = text.let(f"select {text.type(bool)} {inside}, {kind} {args[1]}, {kind} {last}")
        shifted = text.let(f"{instruction} {kind} {args[0]}, {by}")
        if instruction == "ashr":
            return shifted
        zero = text.constant(dtype.type(0))
        return text.let(f"select {text.type(bool)} {inside}, {kind} {shifted}, {kind} {zero}")

    return emit


def _negate(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    if dtype.kind == "f":
        return text.let(f"fneg {text.type(dtype)} {args[0]}")
    return text.let(f"sub {text.type(dtype)} {text.constant(dtype.type(0))}, {args[0]}")


def _write_not(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    ones = np.True_ if dtype == np.bool_ else ~dtype.type(0)
    return text.let(f"xor {text.type(dtype)} {args[0]}, {text.constant(ones)}")


def _absolute(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    if dtype.kind == "f":
        return text.call("llvm.fabs", dtype, args[0])
    negative = _negate(text, op, dtype, [dtype], args)
    return _write_extreme(text, Op("max"), dtype, [dtype] * 2, [args[0], negative])


def _sign(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    """-1, 0 or 1; zeros and NaN stay as they are, and no unsigned number is negative."""
    kind, zero = text.type(dtype), text.constant(dtype.type(0))
    result = args[0] if dtype.kind == "f" else zero
    for order, value in (("gt", 1), ("lt", -1))[: 1 if dtype.kind == "u" else 2]:
        mask = _compare(text, Op(order), dtype, [dtype], [args[0], zero])
        one = text.constant(dtype.type(value))
        result = text.let(f"select {text.type(bool)} {mask}, {kind} {one}, {kind} {result}")
    return result


def _is_finite(text: Text, op: Op, _: np.dtype, kinds: list[np.dtype], args: list[str]) -> str:
    if kinds[0].kind != "f":
        return text.constant(np.True_)
    size = text.call("llvm.fabs", kinds[0], args[0])
    infinity = text.constant(kinds[0].type(np.inf))
    return text.let(f"fcmp olt {text.type(kinds[0])} {size}, {infinity}")


def _unary(intrinsic: str) -> Emit:
    def emit(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
        return text.call(intrinsic, dtype, args[0])

    return emit


def _write_rsqrt(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    root = text.call("llvm.sqrt", dtype, args[0])
    return text.let(f"fdiv {text.type(dtype)} {text.constant(dtype.type(1))}, {root}")


def _round(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    to_even = int(dict(op.params)["rounding_method"]) == 1  # type: ignore[call-overload]
    return text.call("llvm.roundeven" if to_even else "llvm.round", dtype, args[0])


def _count_zeros(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    """Leading zeros: the bits below the highest one are set, and what is not set is counted."""
    kind, x, shift = text.type(dtype), args[0], 1
    while shift < dtype.itemsize * 8:
        moved = text.let(f"lshr {kind} {x}, {text.constant(dtype.type(shift))}")
        x, shift = text.let(f"or {kind} {x}, {moved}"), shift * 2
    return text.call("llvm.ctpop", dtype, _write_not(text, op, dtype, [dtype], [x]))


def _write_conversion(
    text: Text, op: Op, dtype: np.dtype, kinds: list[np.dtype], args: list[str]
) -> str:
    """As XLA does it: a float out of an integer's range becomes the nearest, NaN becomes 0."""
    before, (x, *_) = kinds[0], args
    old, new = text.type(before), text.type(dtype)
    if dtype == np.bool_:
        return _compare(text, Op("ne"), dtype, [before] * 2, [x, text.constant(before.type(0))])
    if dtype.kind == "f":
        if before.kind == "f":
            instruction = "fpext" if dtype.itemsize > before.itemsize else "fptrunc"
        else:
            instruction = "sitofp" if before.kind == "i" else "uitofp"
        return text.let(f"{instruction} {old} {x} to {new}")
    if before.kind == "f":
        return text.saturate(dtype, before, x)
    if before == np.bool_ or dtype.itemsize > before.itemsize:
        return text.let(f"{'sext' if before.kind == 'i' else 'zext'} {old} {x} to {new}")
    if scalar_type(dtype) == scalar_type(before):
        return x
    return text.let(f"trunc {old} {x} to {new}")


def _write_bits(text: Text, op: Op, dtype: np.dtype, kinds: list[np.dtype], args: list[str]) -> str:
    old, new = text.type(kinds[0]), text.type(dtype)
    return args[0] if old == new else text.let(f"bitcast {old} {args[0]} to {new}")


def _math(text: Text, op: Op, dtype: np.dtype, _: list[np.dtype], args: list[str]) -> str:
    return llvm_math.FUNCTIONS[op.name](text, dtype, *args)


def _absent(text: Text, op: Op, *_: Any) -> str:
    raise UnsupportedPrimitive(f"it has no instruction for {op.name!r}")


OPERATIONS: dict[str, Emit] = {
    **dict.fromkeys(FACTS, _absent),
    **dict.fromkeys(llvm_math.FUNCTIONS, _math),
    **dict.fromkeys(_ORDERED, _compare),
    "add": _binary("fadd", "add"),
    "sub": _binary("fsub", "sub"),
    "mul": _binary("fmul", "mul"),
    "and": _binary("", "and"),
    "or": _binary("", "or"),
    "xor": _binary("", "xor"),
    "max": _write_extreme,
    "min": _write_extreme,
    "select_n": _write_select,
    "div": _write_division,
    "rem": _write_division,
    "shift_left": _shift("shl"),
    "shift_right_logical": _shift("lshr"),
    "shift_right_arithmetic": _shift("ashr"),
    "neg": _negate,
    "not": _write_not,
    "abs": _absolute,
    "sign": _sign,
    "is_finite": _is_finite,
    "floor": _unary("llvm.floor"),
    "ceil": _unary("llvm.ceil"),
    "sqrt": _unary("llvm.sqrt"),
    "rsqrt": _write_rsqrt,
    "round": _round,
    "clz": _count_zeros,
    "population_count": _unary("llvm.ctpop"),
    "convert_element_type": _write_conversion,
    "bitcast_convert_type": _write_bits,
}
