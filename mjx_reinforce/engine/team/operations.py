"""How C++ computes each operation of the scalar graph.

What is not plain C++ is a function of ``device/scalar.h``.
"""

import numpy as np

from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS, Op

#: The C++ type of each dtype.
_TYPE_NAMES = {
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
_OPERATIONS = "add sub mul and or xor eq ne lt le gt ge"
_SIGNS = "+ - * & | ^ == != < <= > >="
_INFIX_SIGNS = dict(zip(_OPERATIONS.split(), _SIGNS.split(), strict=True))
#: C++ type -> (suffix of its literals, the unsigned integer of its width).
_LITERAL_FORMS = {"float": ("f", "unsigned"), "double": ("", "unsigned long long")}
#: Functions of floats that the C library and CUDA have under these names, with an f for float32.
_LIBRARY_NAMES = {
    **dict.fromkeys(("floor", "ceil", "sqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p")),
    **dict.fromkeys(("sin", "cos", "tan", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")),
    **dict.fromkeys(("asinh", "acosh", "atanh", "erf", "erfc", "pow", "nextafter")),
    "abs": "fabs",
    "erf_inv": "erfinv",
}
#: Functions of ``device/scalar.h``.
_DEVICE_FUNCTIONS = {
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
    if (name := np.dtype(dtype).name) not in _TYPE_NAMES:
        raise UnsupportedPrimitive(f"it has numbers of {dtype}")
    return _TYPE_NAMES[name]


def literal(number: np.generic) -> str:
    """Returns a constant in C++, to the bit."""
    itemsize = number.dtype.itemsize
    name = type_of(number.dtype)
    if name == "bool":
        return str(bool(number)).lower()
    if name not in _LITERAL_FORMS:
        suffix = "ll" if itemsize == 8 else ""
        if number.dtype.kind == "u":
            suffix = f"u{suffix}"
        return f"({name})({int(number)}{suffix})"
    suffix, word = _LITERAL_FORMS[name]
    if not np.isfinite(number):
        # C++ has no literal for infinity, nor for the payload of a NaN.
        return f"bits<{name}>(({word})({int(number.view(f'u{itemsize}'))}ull))"
    if not number:
        return repr(float(number)) + suffix
    # Hexadecimal digits are exact: no rounding by Python's or by C++'s conversion.
    return float(number).hex() + suffix


def expression(op: Op, dtype: np.dtype, arg_dtypes: list[np.dtype], args: list[str]) -> str:
    """Returns what computes an operation.

    Args:
      op: the operation.
      dtype: of its result.
      arg_dtypes: the dtypes of its operands.
      args: its operands.
    """
    name = op.name
    is_bool = np.dtype(dtype).kind == "b"
    operand_dtype = np.dtype(arg_dtypes[-1])
    is_float = operand_dtype.kind == "f"
    suffix = "f" if operand_dtype == np.float32 else ""
    if name in _INFIX_SIGNS:
        return f"{args[0]} {_INFIX_SIGNS[name]} {args[1]}"
    if name == "select_n":
        return _select(arg_dtypes[0], args)
    if name == "convert_element_type":
        # A cast to an integer type would cut 0.5 to 0; as a bool it is true.
        return f"{args[0]} != 0" if is_bool else f"({type_of(dtype)})({args[0]})"
    if name == "bitcast_convert_type":
        return f"bits<{type_of(dtype)}>({args[0]})"
    if name == "not":
        return f"!{args[0]}" if is_bool else f"~{args[0]}"
    if name == "neg":
        return f"-{args[0]}"
    if name == "round" and is_float:
        is_to_even = int(dict(op.params)["rounding_method"]) == 1  # type: ignore[call-overload]
        function = "rint" if is_to_even else "round"
        return f"{function}{suffix}({args[0]})"
    if name in _LIBRARY_NAMES and is_float:
        return f"{_LIBRARY_NAMES[name] or name}{suffix}({', '.join(args)})"
    if name == "abs":  # of integers: the library's would be fabs
        return f"{args[0]} < 0 ? -{args[0]} : {args[0]}"
    if name in _DEVICE_FUNCTIONS:
        return f"{_DEVICE_FUNCTIONS[name]}({', '.join(args)})"
    assert name in OP_TRAITS
    raise UnsupportedPrimitive(f"it has no C++ for {name!r}")


def _select(index_dtype: np.dtype, args: list[str]) -> str:
    """Returns the case that a bool or an integer, the first of ``args``, chooses."""
    index, *cases = args
    if index_dtype == np.bool_:
        return f"{index} ? {cases[1]} : {cases[0]}"
    # The last test that holds decides: an index out of range gets the nearest case.
    choice = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        choice = f"{index} >= {k} ? {case} : ({choice})"
    return choice
