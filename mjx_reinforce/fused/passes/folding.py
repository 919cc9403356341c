"""What operations make of constants, computed while the graph is built."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.fused import jaxprs
from mjx_reinforce.fused.ops import FACTS, Op


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
