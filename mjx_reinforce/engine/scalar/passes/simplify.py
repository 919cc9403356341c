"""What need not be computed: constants are folded, and algebra makes scalars simpler.

Results are those of IEEE arithmetic, with the exceptions that the package's docstring lists:

- x * 0, 0 / x and x - x are 0, also where x is infinite or NaN.
- x times a bool is 0 where the bool is false, also where x is infinite or NaN.
- The sign of a zero is not kept: x + 0 is x, 0 - x is -x, and -(x - y) is y - x.
- A power with a constant integer exponent up to 8 is a product, which rounds otherwise.

A division by a constant becomes a product only where the reciprocal is exact.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from mjx_reinforce.engine.scalar import jaxprs
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS, Node, Op, Scalar, is_constant, same

# Greater powers are not faster as products than as ``pow``.
_LARGEST_POWER = 8


class Builder(Protocol):
    """What is asked of the graph here: to make a simpler scalar."""

    def call(self, name: str, *args: Scalar) -> Scalar:
        """Applies one of the named operations to scalars."""

    def select(self, predicate: Scalar, on_true: Scalar, on_false: Scalar) -> Scalar:
        """Returns on_true where the predicate holds, else on_false."""


def fold(op: Op, operands: Sequence[Any], dtype: np.dtype) -> Any:
    """Applies an operation to constants, scalars or arrays.

    Args:
      op: the operation.
      operands: NumPy scalars or arrays of one shape.
      dtype: that of the result.

    Returns:
      A NumPy array, or a NumPy scalar where the operands are scalars.
    """
    name = op.name
    if name == "convert_element_type":
        value = np.asarray(operands[0]).astype(dtype)
    elif name == "bitcast_convert_type":
        value = np.asarray(operands[0]).view(dtype)
    elif (function := _EXCEPTIONS.get(name, OP_TRAITS[name].numpy_function)) is not None:
        value = function(*operands)
    else:
        value = jaxprs.compute_constants(jaxprs.operation(name), dict(op.params), operands)[0]
    # NumPy may compute in a wider dtype than JAX. ``[()]`` makes a scalar of an array of no axes.
    return np.asarray(value, dtype)[()]


def _divide(x: np.ndarray, y: np.ndarray) -> Any:
    """Division as XLA does it: integers round towards zero, and by zero it is -1."""
    if not _are_integers(x):
        return np.true_divide(x, y)
    # NumPy rounds towards minus infinity. Less the remainder, which has the sign of x, the division
    # is exact.
    all_ones = ~np.zeros_like(y)  # in an unsigned integer the greatest
    return np.where(y == 0, all_ones, (x - _remainder(x, y)) // np.where(y == 0, 1, y))


def _remainder(x: np.ndarray, y: np.ndarray) -> Any:
    """The rest of that division: an integer divided by zero is what remains."""
    if not _are_integers(x):
        return np.fmod(x, y)
    return np.where(y == 0, x, np.fmod(x, np.where(y == 0, 1, y)))


def _are_integers(x: np.ndarray) -> bool:
    return np.issubdtype(np.asarray(x).dtype, np.integer)


def _choose_case(predicate: np.ndarray, *cases: np.ndarray) -> Any:
    """Picks the case that the predicate numbers."""
    return np.choose(np.asarray(predicate, int), cases)


def _logistic(x: np.ndarray) -> Any:
    """1 / (1 + exp(-x)) in x's dtype."""
    unit = np.asarray(x).dtype.type(1)
    return unit / (unit + np.exp(-x))


def _rsqrt(x: np.ndarray) -> Any:
    """1 / sqrt(x) in x's dtype."""
    return np.asarray(x).dtype.type(1) / np.sqrt(x)


#: What one function of NumPy does not compute. Rare operations that NumPy does not have at all JAX
#: computes at once, in about 1 ms.
_EXCEPTIONS: dict[str, Callable[..., Any]] = {
    "select_n": _choose_case,
    "div": _divide,
    "rem": _remainder,
    "rsqrt": _rsqrt,
    "logistic": _logistic,
}


def simplify(graph: Builder, op: Op, args: tuple[Scalar, ...], dtype: np.dtype) -> Scalar | None:
    """Returns a simpler scalar equal to op(*args), or None; at least one operand is a node."""
    simple_form = None
    if op.name in _RULES:
        simple_form = _RULES[op.name](graph, *args)
    if simple_form is None and op.name != "select_n":
        simple_form = _through_select(graph, op, args, dtype)
    return simple_form


def power(graph: Builder, base: Scalar, exponent: int) -> Scalar:
    """Returns an integer power by repeated multiplication."""
    unit = base.dtype.type(1)
    if exponent < 0:
        return graph.call("div", unit, power(graph, base, -exponent))
    # By squaring: the product takes base^(2^k) for each bit k of the exponent that is set.
    product = unit
    square = base
    while exponent:
        if exponent & 1:
            product = graph.call("mul", product, square)
        exponent >>= 1
        if exponent:
            square = graph.call("mul", square, square)
    return product


def _is(value: Scalar, number: float) -> bool:
    return isinstance(value, np.generic) and bool(value == number)


def _args(value: Scalar, name: str) -> tuple[Scalar, ...] | None:
    """Returns the operands of a node that the named operation computes."""
    if isinstance(value, Node) and value.op is not None and value.op.name == name:
        return value.args
    return None


def _negated(value: Scalar) -> Scalar | None:
    """Returns x where value is -x, else None."""
    operands = _args(value, "neg")
    if operands is None:
        return None
    return operands[0]


def _add(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    """Simplifies x + 0 to x, and x + -y to x - y, in either order."""
    for term, addend in ((x, y), (y, x)):
        if _is(addend, 0):
            return term
        if _negated(addend) is not None:
            return graph.call("sub", term, _negated(addend))
    return None


def _sub(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    """Simplifies x - 0 to x, x - x to 0, 0 - y to -y, and x - -y to x + y."""
    if _is(y, 0):
        return x
    if x is y:
        return x.dtype.type(0)
    if _is(x, 0):
        return graph.call("neg", y)
    if _negated(y) is not None:
        return graph.call("add", x, _negated(y))
    return None


def _mul(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    """Simplifies products with 0, 1, -1, a bool, or a negated scalar, whose sign moves outwards."""
    for factor, scale in ((x, y), (y, x)):
        if _is(scale, 0):
            return scale.dtype.type(0)
        if _is(scale, 1):
            return factor
        if _is(scale, -1) and not np.issubdtype(scale.dtype, np.unsignedinteger):
            return graph.call("neg", factor)
        if _negated(factor) is not None:
            # A constant takes the sign itself, which saves an operation.
            if is_constant(scale):
                return graph.call("mul", _negated(factor), -scale)
            return graph.call("neg", graph.call("mul", _negated(factor), scale))
        masked_factor = _mask(graph, factor, scale)
        if masked_factor is not None:
            return masked_factor
    return None


def _mask(graph: Builder, mask: Scalar, value: Scalar) -> Scalar | None:
    """Turns a product with a bool's 1 or 0 into a selection."""
    operands = _args(mask, "select_n")
    # A product with a constant folds into the two cases of the selection, see ``_through_select``.
    if operands and not is_constant(value):
        predicate, on_false, on_true = operands
        zero = value.dtype.type(0)
        if _is(on_false, 0) and _is(on_true, 1):
            return graph.select(predicate, value, zero)
        if _is(on_false, 1) and _is(on_true, 0):
            return graph.select(predicate, zero, value)
    return None


def _div(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    """Simplifies 0 / x to 0, x / 1 to x, and a division by a power of 2 to a product."""
    if _is(x, 0) and np.issubdtype(x.dtype, np.floating):  # an integer 0 / 0 is -1
        return x
    if is_constant(y) and np.issubdtype(y.dtype, np.floating):
        mantissa, exponent = np.frexp(y)
        # The bound keeps reciprocals far from the least normal number of float32, 2^-126.
        if abs(mantissa) == 0.5 and abs(exponent) < 100:
            return graph.call("mul", x, y.dtype.type(1) / y)
    if _is(y, 1):
        return x
    return None


def _pow(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    if is_constant(y) and float(y).is_integer() and abs(y) <= _LARGEST_POWER:
        return power(graph, x, int(y))
    return None


def _neg(graph: Builder, x: Scalar) -> Scalar | None:
    """Simplifies -(-x) to x, and -(x - y) to y - x."""
    if _negated(x) is not None:
        return _negated(x)
    operands = _args(x, "sub")
    if operands is None:
        return None
    return graph.call("sub", operands[1], operands[0])


def _abs(graph: Builder, x: Scalar) -> Scalar | None:
    negative = _negated(x)
    if negative is None:
        return None
    return graph.call("abs", negative)


def _extreme(x: Scalar, y: Scalar, identity: float) -> Scalar | None:
    """Simplifies ``max`` and ``min`` of a scalar and itself, or the number that never wins."""
    if x is y or _is(y, identity):
        return x
    if _is(x, identity):
        return y
    return None


def _bitwise(x: Scalar, y: Scalar, zero_element: bool) -> Scalar | None:
    """Simplifies ``and`` (absorbing False) and ``or`` (absorbing True) of bools."""
    if x.dtype != np.bool_:
        return None
    for operand, flag in ((x, y), (y, x)):
        if is_constant(flag):
            return flag if bool(flag) is zero_element else operand
    if x is y:
        return x
    return None


def _not(graph: Builder, x: Scalar) -> Scalar | None:
    operands = _args(x, "not")
    if operands is None:
        return None
    return operands[0]


def _select(graph: Builder, predicate: Scalar, *cases: Scalar) -> Scalar | None:
    """Simplifies a selection whose predicate or whose cases decide it."""
    if len(cases) != 2:
        return cases[int(predicate)] if is_constant(predicate) else None
    on_false, on_true = cases
    if is_constant(predicate):
        return on_true if predicate else on_false
    if same(on_true, on_false):
        return on_true
    # Without the "not", and with the cases swapped, equal selections are one node.
    inverse = _args(predicate, "not")
    if inverse:
        return graph.select(inverse[0], on_false, on_true)
    if on_true.dtype == np.bool_:
        simple_form = _select_bool(graph, predicate, on_true, on_false)
        if simple_form is not None:
            return simple_form
    return _select_again(graph, predicate, on_true, on_false)


def _select_bool(
    graph: Builder, predicate: Scalar, on_true: Scalar, on_false: Scalar
) -> Scalar | None:
    """Turns a selection among bools, one of them a constant, into "and", "or" and "not"."""
    if _is(on_true, True) and _is(on_false, False):
        return predicate
    if _is(on_true, True):
        return graph.call("or", predicate, on_false)
    if _is(on_false, False):
        return graph.call("and", predicate, on_true)
    if _is(on_true, False):
        negation = graph.call("not", predicate)
        return negation if _is(on_false, True) else graph.call("and", negation, on_false)
    if _is(on_false, True):
        return graph.call("or", graph.call("not", predicate), on_true)
    return None


def _select_again(
    graph: Builder, predicate: Scalar, on_true: Scalar, on_false: Scalar
) -> Scalar | None:
    """Drops the case of an inner selection that the same predicate rules out."""
    inner_args = _args(on_true, "select_n")
    if inner_args and len(inner_args) == 3 and inner_args[0] is predicate:
        return graph.select(predicate, inner_args[2], on_false)
    inner_args = _args(on_false, "select_n")
    if inner_args and len(inner_args) == 3 and inner_args[0] is predicate:
        return graph.select(predicate, on_true, inner_args[1])
    return None


def _through_select(
    graph: Builder, op: Op, args: tuple[Scalar, ...], dtype: np.dtype
) -> Scalar | None:
    """Folds an operation whose operands are constants and selections among constants."""
    nodes = [arg for arg in args if isinstance(arg, Node)]
    # A bool that becomes a number is a selection of 1 and 0: ``_mask`` finds it in a product.
    if op.name == "convert_element_type" and nodes[0].dtype == np.bool_ and dtype != np.bool_:
        return graph.select(nodes[0], dtype.type(1), dtype.type(0))
    # All selections must share one predicate: then the operation has two possible results.
    for node in nodes:
        choice = _args(node, "select_n")
        if choice is None or len(choice) != 3 or choice[0] is not nodes[0].args[0]:
            return None
        if not (is_constant(choice[1]) and is_constant(choice[2])):
            return None
    cases = []
    for case_index in (1, 2):
        case_args = [arg if is_constant(arg) else arg.args[case_index] for arg in args]
        cases.append(fold(op, case_args, dtype))
    return graph.select(nodes[0].args[0], cases[1], cases[0])


_RULES: dict[str, Callable[..., Scalar | None]] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "pow": _pow,
    "neg": _neg,
    "abs": _abs,
    "max": lambda _, x, y: _extreme(x, y, -np.inf),
    "min": lambda _, x, y: _extreme(x, y, np.inf),
    "and": lambda _, x, y: _bitwise(x, y, zero_element=False),
    "or": lambda _, x, y: _bitwise(x, y, zero_element=True),
    "not": _not,
    "select_n": _select,
}
