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
#: The least and the greatest integer of 8 bits.
_LIMITS = {"int8": (-128, 127), "uint8": (0, 255)}
#: C++ type -> (suffix of its literals, the unsigned integer of its width).
_LITERAL_FORMS = {"float": ("f", "unsigned"), "double": ("", "unsigned long long")}
#: Functions of floats that take many instructions, and have their own names in the C library.
_LONG = (
    *("cbrt", "exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    *("asin", "acos", "atan", "atan2", "asinh", "acosh", "atanh", "erf", "erfc", "pow"),
)
#: All that take many instructions.
LONG_FUNCTIONS = frozenset((*_LONG, "erf_inv", "logistic"))
#: Functions of floats that the C library and CUDA have under these names, with an f for float32.
_LIBRARY_NAMES = {
    **dict.fromkeys(("floor", "ceil", "sqrt", "nextafter", *_LONG)),
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


def _ones(dtype: np.dtype, x: str) -> str:
    """Returns how many bits of an integer are set."""
    return f"count({_bits_of(dtype, x)})"


def _leading_zeros(dtype: np.dtype, x: str) -> str:
    """Returns how many bits of an integer are above the highest one that is set."""
    bits = _bits_of(dtype, x)
    width = 8 * dtype.itemsize
    # The exponent of a float says where that bit is; without the bit below it, none rounds up.
    exponent = f"int(bits<unsigned>(float({bits} & ~({bits} >> 1))) >> 23)"
    return f"({bits} == 0 ? {width} : {width + 126} - {exponent})"


def _bits_of(dtype: np.dtype, x: str) -> str:
    """Returns an integer of 8 or 32 bits as an unsigned one of 32."""
    if dtype.itemsize > 4:
        raise UnsupportedPrimitive("bits of integers of 64 bits are not counted")
    return f"(unsigned)({_TYPE_NAMES[f'uint{8 * dtype.itemsize}']})({x})"


#: (dtype, an integer) -> what is counted of its bits
_BIT_COUNTS = {"population_count": _ones, "clz": _leading_zeros}
#: As what a shift takes a byte.
_SHIFTED_BYTES = {"shift_right_logical": "unsigned char", "shift_right_arithmetic": "signed char"}


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
        return f"{args[0]} != 0" if is_bool else _cast(dtype, operand_dtype, args[0])
    if name in _BIT_COUNTS and not is_float:
        return _BIT_COUNTS[name](operand_dtype, args[0])
    if name in _SHIFTED_BYTES and operand_dtype.itemsize == 1:
        # C++ shifts a byte as an int, whose higher bits are those that its type says.
        args = [f"({_SHIFTED_BYTES[name]})({args[0]})", args[1]]
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


def _cast(dtype: np.dtype, source_dtype: np.dtype, x: str) -> str:
    """Returns a number as one of another type."""
    if source_dtype.kind == "f" and dtype.itemsize == 1:
        # As XLA does it: out of the range is the nearest. Of 32 bits a GPU does so itself.
        low, high = (literal(source_dtype.type(x)) for x in _LIMITS[np.dtype(dtype).name])
        x = f"int(smaller(larger({x}, {low}), {high}))"
    return f"({type_of(dtype)})({x})"


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
