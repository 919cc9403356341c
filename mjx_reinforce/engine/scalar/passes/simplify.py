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
from mjx_reinforce.engine.scalar.nodes import FACTS, Node, Op, Scalar, is_constant, same

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
        result = np.asarray(operands[0]).astype(dtype)
    elif name == "bitcast_convert_type":
        result = np.asarray(operands[0]).view(dtype)
    elif (by_numpy := _EXCEPTIONS.get(name, FACTS[name].in_numpy)) is not None:
        result = by_numpy(*operands)
    else:
        result = jaxprs.compute_constants(jaxprs.operation(name), dict(op.params), operands)[0]
    return np.asarray(result, dtype)[()]


def _divide(x: np.ndarray, y: np.ndarray) -> Any:
    """Division as XLA does it: integers round towards zero, and by zero it is -1."""
    if not _are_integers(x):
        return np.true_divide(x, y)
    ones = ~np.zeros_like(y)  # -1, in an unsigned integer the greatest
    return np.where(y == 0, ones, (x - _remainder(x, y)) // np.where(y == 0, 1, y))


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
    one = np.asarray(x).dtype.type(1)
    return one / (one + np.exp(-x))


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
    rule = _RULES.get(op.name)
    simpler = rule(graph, *args) if rule else None
    if simpler is None and op.name != "select_n":
        simpler = _through_select(graph, op, args, dtype)
    return simpler


def power(graph: Builder, base: Scalar, exponent: int) -> Scalar:
    """Returns an integer power by repeated multiplication."""
    one = base.dtype.type(1)
    if exponent < 0:
        return graph.call("div", one, power(graph, base, -exponent))
    result, square = one, base
    while exponent:
        if exponent & 1:
            result = graph.call("mul", result, square)
        exponent >>= 1
        if exponent:
            square = graph.call("mul", square, square)
    return result


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
    return operands[0] if operands else None


def _add(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    for left, right in ((x, y), (y, x)):
        if _is(right, 0):
            return left
        if _negated(right) is not None:
            return graph.call("sub", left, _negated(right))
    return None


def _sub(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
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
    for left, right in ((x, y), (y, x)):
        if _is(right, 0):
            return right.dtype.type(0)
        if _is(right, 1):
            return left
        if _is(right, -1) and not np.issubdtype(right.dtype, np.unsignedinteger):
            return graph.call("neg", left)
        if _negated(left) is not None:
            if is_constant(right):
                return graph.call("mul", _negated(left), -right)
            return graph.call("neg", graph.call("mul", _negated(left), right))
        masked = _mask(graph, left, right)
        if masked is not None:
            return masked
    return None


def _mask(graph: Builder, mask: Scalar, value: Scalar) -> Scalar | None:
    """Turns a product with a bool's 1 or 0 into a selection."""
    operands = _args(mask, "select_n")
    if operands and not is_constant(value):
        predicate, on_false, on_true = operands
        zero = value.dtype.type(0)
        if _is(on_false, 0) and _is(on_true, 1):
            return graph.select(predicate, value, zero)
        if _is(on_false, 1) and _is(on_true, 0):
            return graph.select(predicate, zero, value)
    return None


def _div(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    if _is(x, 0) and np.issubdtype(x.dtype, np.floating):  # an integer 0 / 0 is -1
        return x
    if is_constant(y) and np.issubdtype(y.dtype, np.floating):
        mantissa, exponent = np.frexp(y)
        if abs(mantissa) == 0.5 and abs(exponent) < 100:
            return graph.call("mul", x, y.dtype.type(1) / y)
    return x if _is(y, 1) else None


def _pow(graph: Builder, x: Scalar, y: Scalar) -> Scalar | None:
    if is_constant(y) and float(y).is_integer() and abs(y) <= _LARGEST_POWER:
        return power(graph, x, int(y))
    return None


def _neg(graph: Builder, x: Scalar) -> Scalar | None:
    if _negated(x) is not None:
        return _negated(x)
    operands = _args(x, "sub")
    return graph.call("sub", operands[1], operands[0]) if operands else None


def _abs(graph: Builder, x: Scalar) -> Scalar | None:
    return graph.call("abs", _negated(x)) if _negated(x) is not None else None


def _extreme(x: Scalar, y: Scalar, neutral: float) -> Scalar | None:
    if x is y or _is(y, neutral):
        return x
    return y if _is(x, neutral) else None


def _bitwise(x: Scalar, y: Scalar, absorbing: bool) -> Scalar | None:
    """Simplifies ``and`` (absorbing False) and ``or`` (absorbing True) of bools."""
    if x.dtype != np.bool_:
        return None
    for left, right in ((x, y), (y, x)):
        if is_constant(right):
            return right if bool(right) is absorbing else left
    return x if x is y else None


def _not(graph: Builder, x: Scalar) -> Scalar | None:
    operands = _args(x, "not")
    return operands[0] if operands else None


def _select(graph: Builder, predicate: Scalar, *cases: Scalar) -> Scalar | None:
    if len(cases) != 2:
        return cases[int(predicate)] if is_constant(predicate) else None
    on_false, on_true = cases
    if is_constant(predicate):
        return on_true if predicate else on_false
    if same(on_true, on_false):
        return on_true
    inverse = _args(predicate, "not")
    if inverse:
        return graph.select(inverse[0], on_false, on_true)
    if on_true.dtype == np.bool_:
        simpler = _select_bool(graph, predicate, on_true, on_false)
        if simpler is not None:
            return simpler
    return _select_again(graph, predicate, on_true, on_false)


def _select_bool(
    graph: Builder, predicate: Scalar, on_true: Scalar, on_false: Scalar
) -> Scalar | None:
    if _is(on_true, True):
        return predicate if _is(on_false, False) else graph.call("or", predicate, on_false)
    if _is(on_false, False):
        return graph.call("and", predicate, on_true)
    if _is(on_true, False):
        opposite = graph.call("not", predicate)
        return opposite if _is(on_false, True) else graph.call("and", opposite, on_false)
    if _is(on_false, True):
        return graph.call("or", graph.call("not", predicate), on_true)
    return None


def _select_again(
    graph: Builder, predicate: Scalar, on_true: Scalar, on_false: Scalar
) -> Scalar | None:
    """Drops the case of an inner selection that the same predicate rules out."""
    inner = _args(on_true, "select_n")
    if inner and len(inner) == 3 and inner[0] is predicate:
        return graph.select(predicate, inner[2], on_false)
    inner = _args(on_false, "select_n")
    if inner and len(inner) == 3 and inner[0] is predicate:
        return graph.select(predicate, on_true, inner[1])
    return None


def _through_select(
    graph: Builder, op: Op, args: tuple[Scalar, ...], dtype: np.dtype
) -> Scalar | None:
    """Folds an operation whose operands are constants and selections among constants."""
    nodes = [arg for arg in args if isinstance(arg, Node)]
    if op.name == "convert_element_type" and nodes[0].dtype == np.bool_ and dtype != np.bool_:
        return graph.select(nodes[0], dtype.type(1), dtype.type(0))
    for node in nodes:
        choice = _args(node, "select_n")
        if choice is None or len(choice) != 3 or choice[0] is not nodes[0].args[0]:
            return None
        if not (is_constant(choice[1]) and is_constant(choice[2])):
            return None
    cases = []
    for case in (1, 2):
        chosen = [arg if is_constant(arg) else arg.args[case] for arg in args]
        cases.append(fold(op, chosen, dtype))
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
    "and": lambda _, x, y: _bitwise(x, y, absorbing=False),
    "or": lambda _, x, y: _bitwise(x, y, absorbing=True),
    "not": _not,
    "select_n": _select,
}
