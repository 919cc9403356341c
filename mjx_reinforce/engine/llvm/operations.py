"""How LLVM IR computes each operation of the scalar graph, lane by lane."""

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_reinforce.engine.llvm.lanes import INFINITY, Lanes
from mjx_reinforce.engine.llvm.math import FUNCTIONS
from mjx_reinforce.engine.llvm.text import scalar_type
from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import FACTS, Op

#: (operation, dtype of the result, operands) -> the result
Emit = Callable[..., Lanes]

_COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")


def is_constant_text(operand: str) -> bool:
    """Returns whether an operand's text is a constant."""
    return not operand.startswith("%")


def _extreme(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
    """The greater or the lesser; NaN where either is NaN."""
    if dtype == np.bool_:
        return x | y if op.name == "max" else x & y
    if dtype.kind != "f":
        return x.call(f"{'s' if dtype.kind == 'i' else 'u'}{op.name}", y)
    if is_constant_text(x.name):  # a constant is not NaN, and one comparison is enough
        x, y = y, x
    order = "gt" if op.name == "max" else "lt"
    if is_constant_text(y.name):
        first = x.write(f"fcmp u{order}", y, dtype=bool)
    else:
        first = x.compare(order, y) | x.write("fcmp uno", x, dtype=bool)
    return first.where(x, y)


def _select(op: Op, dtype: np.dtype, which: Lanes, *cases: Lanes) -> Lanes:
    """Picks the case that the first operand numbers."""
    chosen = cases[0]
    for number, case in enumerate(cases[1:], start=1):
        is_bool = which.dtype == np.bool_
        mask = which if is_bool else which.write("icmp sge", number, dtype=bool)
        chosen = mask.where(case, chosen)
    return chosen


def _divide(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
    """Division or its rest; by an integer zero as XLA does it: -1, or the dividend.

    A processor stops the program where it divides by an integer zero, or the least one by -1.
    """
    if dtype.kind == "f":
        return x / y if op.name == "div" else x.write("frem", y)
    is_signed, ones = dtype.kind == "i", x.like(~dtype.type(0))

    def by(number: Lanes | int, chosen: Lanes | int, otherwise: Lanes) -> Lanes:
        return y.compare("eq", number).where(chosen, otherwise)

    divisor = by(0, 1, y)
    if is_signed:
        divisor = by(ones, 1, divisor)
    result = x.write(("s" if is_signed else "u") + op.name, divisor)
    if is_signed and op.name == "div":
        result = by(ones, 0 - x, result)
    return by(0, ones if op.name == "div" else x, result)


def _shift(instruction: str) -> Emit:
    """A shift; by as many bits as there are, or more, nothing is left but copies of the sign."""

    def emit(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
        last = dtype.itemsize * 8 - 1
        inside = y.write("icmp ule", last, dtype=bool)
        shifted = x.write(instruction, inside.where(y, last))
        return shifted if instruction == "ashr" else inside.where(shifted, 0)

    return emit


def _invert(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    return x ^ x.like(True if dtype == np.bool_ else ~dtype.type(0))


def _sign(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """-1, 0 or 1; zeros and NaN stay as they are, and no unsigned number is negative."""
    result = x if dtype.kind == "f" else x.like(0)
    for order, value in (("gt", 1), ("lt", -1))[: 1 if dtype.kind == "u" else 2]:
        result = x.compare(order, 0).where(value, result)
    return result


def _is_finite(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    if x.dtype.kind != "f":
        return x.named(x.text.constant(np.True_))
    return abs(x) < INFINITY


def _unary(intrinsic: str) -> Emit:
    return lambda op, dtype, x: x.call(intrinsic)


def _round(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    to_even = int(dict(op.params)["rounding_method"]) == 1  # type: ignore[call-overload]
    return x.call("roundeven" if to_even else "round")


def _count_zeros(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """Leading zeros: the bits below the highest one are set, and what is not set is counted."""
    shift = 1
    while shift < dtype.itemsize * 8:
        x, shift = x | x.write("lshr", shift), shift * 2
    return _invert(op, dtype, x).call("ctpop")


def _convert(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """As XLA does it: a float out of an integer's range becomes the nearest, NaN becomes 0."""
    before = x.dtype
    if dtype == np.bool_:
        return x.compare("ne", 0)
    if dtype.kind == "f":
        if before.kind == "f":
            return x.convert("fpext" if dtype.itemsize > before.itemsize else "fptrunc", dtype)
        return x.convert("sitofp" if before.kind == "i" else "uitofp", dtype)
    if before.kind == "f":
        return x.named(x.text.saturate(dtype, before, x.name))
    if before == np.bool_ or dtype.itemsize > before.itemsize:
        return x.convert("sext" if before.kind == "i" else "zext", dtype)
    return x if scalar_type(dtype) == scalar_type(before) else x.convert("trunc", dtype)


def _math(op: Op, dtype: np.dtype, *operands: Lanes) -> Lanes:
    return FUNCTIONS[dtype.name][op.name](*operands)


def _absent(op: Op, *_: Any) -> Lanes:
    raise UnsupportedPrimitive(f"it has no instruction for {op.name!r}")


OPERATIONS: dict[str, Emit] = {
    **dict.fromkeys(FACTS, _absent),
    **dict.fromkeys(FUNCTIONS["float32"], _math),
    **dict.fromkeys(_COMPARISONS, lambda op, _, x, y: x.compare(op.name, y)),
    **dict.fromkeys(("max", "min"), _extreme),
    **dict.fromkeys(("div", "rem"), _divide),
    **{name: _unary(name) for name in ("floor", "ceil", "sqrt")},
    "add": lambda op, dtype, x, y: x + y,
    "sub": lambda op, dtype, x, y: x - y,
    "mul": lambda op, dtype, x, y: x * y,
    "and": lambda op, dtype, x, y: x & y,
    "or": lambda op, dtype, x, y: x | y,
    "xor": lambda op, dtype, x, y: x ^ y,
    "select_n": _select,
    "shift_left": _shift("shl"),
    "shift_right_logical": _shift("lshr"),
    "shift_right_arithmetic": _shift("ashr"),
    "neg": lambda op, dtype, x: -x if dtype.kind == "f" else 0 - x,
    "not": _invert,
    "abs": lambda op, dtype, x: (
        abs(x) if dtype.kind == "f" else _extreme(Op("max"), dtype, x, 0 - x)
    ),
    "sign": _sign,
    "is_finite": _is_finite,
    "rsqrt": lambda op, dtype, x: x.like(1).write("fdiv", x.call("sqrt")),
    "round": _round,
    "clz": _count_zeros,
    "population_count": _unary("ctpop"),
    "convert_element_type": _convert,
    "bitcast_convert_type": lambda op, dtype, x: (
        x if scalar_type(dtype) == scalar_type(x.dtype) else x.convert("bitcast", dtype)
    ),
}
