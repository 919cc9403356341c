"""How LLVM IR computes each operation of the scalar graph, lane by lane."""

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_reinforce.engine.llvm.lanes import INFINITY, Lanes
from mjx_reinforce.engine.llvm.math import FUNCTIONS
from mjx_reinforce.engine.llvm.text import scalar_type, sign_letter
from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS, Op

#: (operation, dtype of the result, operands) -> the result
Emit = Callable[..., Lanes]

#: Which comparison with the second operand the one that is taken meets.
_EXTREME_ORDERS = {"max": "gt", "min": "lt"}
_COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")


def is_constant_text(operand: str) -> bool:
    """Returns whether an operand's text is a constant."""
    return not operand.startswith("%")


def _extreme(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
    """The greater or the lesser; NaN where either is NaN."""
    if dtype == np.bool_:
        return x | y if op.name == "max" else x & y
    if dtype.kind != "f":
        return x.call(sign_letter(dtype) + op.name, y)
    if is_constant_text(x.name):
        x, y = y, x
    order = _EXTREME_ORDERS[op.name]
    # x is taken where it is NaN, and y, by a comparison that is false, where y is. A constant is
    # not NaN: beside it one comparison, true with NaN, is enough.
    if is_constant_text(y.name):
        is_x = x.write(f"fcmp u{order}", y, dtype=bool)
    else:
        is_x = x.compare(order, y) | x.write("fcmp uno", x, dtype=bool)
    return is_x.where(x, y)


def _select(op: Op, dtype: np.dtype, index: Lanes, *cases: Lanes) -> Lanes:
    """Picks the case that the first operand numbers."""
    selection = cases[0]
    for case_index, case in enumerate(cases[1:], start=1):
        mask = index
        if index.dtype != np.bool_:
            mask = index.write("icmp sge", case_index, dtype=bool)
        selection = mask.where(case, selection)
    return selection


def _divide(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
    """Division or its rest; by an integer zero as XLA does it: -1, or the dividend.

    A processor stops the program where it divides by an integer zero, or the least one by -1.
    """
    is_division = op.name == "div"
    if dtype.kind == "f":
        return x / y if is_division else x.write("frem", y)
    is_signed = dtype.kind == "i"
    all_ones = x.like(~dtype.type(0))  # of unsigned integers the greatest

    def where_y_is(y_value: Lanes | int, choice: Lanes | int, default: Lanes) -> Lanes:
        return y.compare("eq", y_value).where(choice, default)

    # Lanes whose divisor is 0 or -1 divide by 1 instead, and their results are put in afterwards.
    # The rest of a division by -1 is the same 0 as that by 1.
    divisor = where_y_is(0, 1, y)
    if is_signed:
        divisor = where_y_is(all_ones, 1, divisor)
    quotient = x.write(sign_letter(dtype) + op.name, divisor)
    if is_signed and is_division:
        quotient = where_y_is(all_ones, 0 - x, quotient)
    return where_y_is(0, all_ones if is_division else x, quotient)


def _shift(instruction: str) -> Emit:
    """A shift; by as many bits as there are, or more, nothing is left but copies of the sign."""

    def emit(op: Op, dtype: np.dtype, x: Lanes, y: Lanes) -> Lanes:
        """Shifts by y; LLVM leaves a shift by more undefined, and a negative y is more too."""
        max_shift = dtype.itemsize * 8 - 1
        is_inside = y.write("icmp ule", max_shift, dtype=bool)
        shift_value = x.write(instruction, is_inside.where(y, max_shift))
        if instruction == "ashr":
            return shift_value
        return is_inside.where(shift_value, 0)

    return emit


def _invert(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    return x ^ x.like(~dtype.type(0))


def _sign(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """-1, 0 or 1; zeros and NaN stay as they are, and no unsigned number is negative."""
    # Comparisons with NaN are false and leave it; a zero keeps its own sign.
    sign = x if dtype.kind == "f" else x.like(0)
    sign = x.compare("gt", 0).where(1, sign)
    if dtype.kind == "u":
        return sign
    return x.compare("lt", 0).where(-1, sign)


def _is_finite(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    if x.dtype.kind != "f":
        return x.named(x.text.constant(np.True_))
    return abs(x) < INFINITY


def _unary(intrinsic: str) -> Emit:
    return lambda op, dtype, x: x.call(intrinsic)


def _round(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    is_to_even = int(dict(op.params)["rounding_method"]) == 1  # type: ignore[call-overload]
    return x.call("roundeven" if is_to_even else "round")


def _count_zeros(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """Leading zeros: the bits below the highest one are set, and what is not set is counted."""
    shift = 1
    while shift < dtype.itemsize * 8:
        x = x | x.write("lshr", shift)
        shift *= 2
    return _invert(op, dtype, x).call("ctpop")


def _convert(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    """As XLA does it: a float out of an integer's range becomes the nearest, NaN becomes 0."""
    source_dtype = x.dtype
    is_wider = dtype.itemsize > source_dtype.itemsize
    if dtype == np.bool_:
        return x.compare("ne", 0)
    if dtype.kind == "f":
        if source_dtype.kind == "f":
            return x.convert("fpext" if is_wider else "fptrunc", dtype)
        return x.convert(f"{sign_letter(source_dtype)}itofp", dtype)
    if source_dtype.kind == "f":
        # LLVM's plain conversion is undefined out of the range.
        return x.named(x.text.saturate(dtype, source_dtype, x.name))
    # A bool is a byte in NumPy and a bit here, so that it widens to a byte too.
    if source_dtype == np.bool_ or is_wider:
        return x.convert("sext" if source_dtype.kind == "i" else "zext", dtype)
    if scalar_type(dtype) == scalar_type(source_dtype):
        return x
    return x.convert("trunc", dtype)


def _bitcast(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    # LLVM has one type for signed and unsigned integers.
    if scalar_type(dtype) == scalar_type(x.dtype):
        return x
    return x.convert("bitcast", dtype)


def _absolute(op: Op, dtype: np.dtype, x: Lanes) -> Lanes:
    if dtype.kind == "f":
        return abs(x)
    return _extreme(Op("max"), dtype, x, 0 - x)


def _math(op: Op, dtype: np.dtype, *operands: Lanes) -> Lanes:
    return FUNCTIONS[dtype.name][op.name](*operands)


def _absent(op: Op, *_: Any) -> Lanes:
    raise UnsupportedPrimitive(f"it has no instruction for {op.name!r}")


OPERATIONS: dict[str, Emit] = {
    **dict.fromkeys(OP_TRAITS, _absent),
    **dict.fromkeys(FUNCTIONS["float32"], _math),
    **dict.fromkeys(_COMPARISONS, lambda op, _, x, y: x.compare(op.name, y)),
    **dict.fromkeys(_EXTREME_ORDERS, _extreme),
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
    "abs": _absolute,
    "sign": _sign,
    "is_finite": _is_finite,
    "rsqrt": lambda op, dtype, x: x.like(1).write("fdiv", x.call("sqrt")),
    "round": _round,
    "clz": _count_zeros,
    "population_count": _unary("ctpop"),
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
}
