"""How C++ computes each operation of the scalar graph.

What is not plain C++ is a function of ``device/scalar.h``.
"""

import numpy as np

from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import FACTS, Op

#: The C++ type of each dtype.
_TYPES = {
    "bool": "bool",
    "int8": "signed char",
    "uint8": "unsigned char",
    "int32": "int",
    "uint32": "unsigned",
    "int64": "long long",
    "uint64": "unsigned long long",
    "float32": "float",
    "float64": "double",
}
_NAMES, _SIGNS = "add sub mul and or xor eq ne lt le gt ge", "+ - * & | ^ == != < <= > >="
_INFIX = dict(zip(_NAMES.split(), _SIGNS.split(), strict=True))
#: Functions of floats that the C library and CUDA have under these names, with an f for float32.
_LIBRARY = {
    **dict.fromkeys(("floor", "ceil", "sqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p")),
    **dict.fromkeys(("sin", "cos", "tan", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")),
    **dict.fromkeys(("asinh", "acosh", "atanh", "erf", "erfc", "pow", "nextafter")),
    "abs": "fabs",
    "erf_inv": "erfinv",
}
#: Functions of ``device/scalar.h``.
_OURS = {
    "max": "larger",
    "min": "smaller",
    "div": "divide",
    "rem": "rest",
    "rsqrt": "rsqrt_of",
    "logistic": "logistic",
    "sign": "sign_of",
    "is_finite": "is_finite",
    "shift_left": "left",
    "shift_right_logical": "right",
    "shift_right_arithmetic": "right_signed",
}


def type_of(dtype: np.dtype) -> str:
    """Returns the C++ type of a dtype."""
    if (name := np.dtype(dtype).name) not in _TYPES:
        raise UnsupportedPrimitive(f"it has numbers of {dtype}")
    return _TYPES[name]


def literal(number: np.generic) -> str:
    """Returns a constant in C++, to the bit."""
    kind, name = number.dtype.kind, type_of(number.dtype)
    if kind == "b":
        return "true" if number else "false"
    if kind in "iu":
        suffix = ("u" if kind == "u" else "") + ("ll" if number.dtype.itemsize == 8 else "")
        return f"({name})({int(number)}{suffix})"
    if not np.isfinite(number):
        word = "unsigned" if name == "float" else "unsigned long long"
        return f"bits<{name}>(({word})({int(number.view(f'u{number.dtype.itemsize}'))}ull))"
    exact = float(number).hex() if number else repr(float(number))
    return exact + ("f" if name == "float" else "")


def expression(op: Op, dtype: np.dtype, kinds: list[np.dtype], args: list[str]) -> str:
    """Returns what computes an operation.

    Args:
      op: the operation.
      dtype: of its result.
      kinds: the dtypes of its operands.
      args: its operands.
    """
    name, kind, of = op.name, np.dtype(dtype).kind, np.dtype(kinds[-1])
    suffix = "f" if of == np.float32 else ""
    if name in _INFIX:
        return f"{args[0]} {_INFIX[name]} {args[1]}"
    if name == "select_n":
        return _select(kinds[0], args)
    if name == "convert_element_type":
        return f"{args[0]} != 0" if kind == "b" else f"({type_of(dtype)})({args[0]})"
    if name == "bitcast_convert_type":
        return f"bits<{type_of(dtype)}>({args[0]})"
    if name == "not":
        return f"{'!' if kind == 'b' else '~'}{args[0]}"
    if name == "neg":
        return f"-{args[0]}"
    if name == "round" and of.kind == "f":
        to_even = int(dict(op.params)["rounding_method"]) == 1  # type: ignore[call-overload]
        return f"{'rint' if to_even else 'round'}{suffix}({args[0]})"
    if name in _LIBRARY and of.kind == "f":
        return f"{_LIBRARY[name] or name}{suffix}({', '.join(args)})"
    if name == "abs":
        return f"{args[0]} < 0 ? -{args[0]} : {args[0]}"
    if name in _OURS:
        return f"{_OURS[name]}({', '.join(args)})"
    assert name in FACTS
    raise UnsupportedPrimitive(f"it has no C++ for {name!r}")


def _select(which: np.dtype, args: list[str]) -> str:
    number, *cases = args
    if which == np.bool_:
        return f"{number} ? {cases[1]} : {cases[0]}"
    chosen = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        chosen = f"{number} >= {k} ? {case} : ({chosen})"
    return chosen
