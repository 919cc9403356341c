"""What operations make of constants, computed while the graph is built."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax import lax

from mjx_reinforce.fused import jaxprs
from mjx_reinforce.fused.ops import Op


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
    elif name in _BY_NUMPY:
        result = _BY_NUMPY[name](*operands)
    else:
        result = jaxprs.evaluate(_BY_JAX[name], dict(op.params), operands)[0]
    return np.asarray(result, dtype)[()]


def _divide(x: Any, y: Any) -> Any:
    """Division as XLA does it: integers round towards zero."""
    if np.issubdtype(np.asarray(x).dtype, np.integer):
        return np.where(y == 0, -1, (x - np.fmod(x, y)) // np.where(y == 0, 1, y))
    return np.true_divide(x, y)


def _select(predicate: Any, *cases: Any) -> Any:
    """Picks the case that the predicate numbers."""
    return np.choose(np.asarray(predicate, int), cases)


def _logistic(x: Any) -> Any:
    """1 / (1 + exp(-x)) in x's dtype."""
    one = np.asarray(x).dtype.type(1)
    return one / (one + np.exp(-x))


def _rsqrt(x: Any) -> Any:
    """1 / sqrt(x) in x's dtype."""
    return np.asarray(x).dtype.type(1) / np.sqrt(x)


_BY_NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "mul": np.multiply,
    "max": np.maximum,
    "min": np.minimum,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "is_finite": np.isfinite,
    "select_n": _select,
    "sub": np.subtract,
    "div": _divide,
    "rem": np.fmod,
    "pow": np.power,
    "atan2": np.arctan2,
    "nextafter": np.nextafter,
    "shift_left": np.left_shift,
    "neg": np.negative,
    "not": np.invert,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "sqrt": np.sqrt,
    "rsqrt": _rsqrt,
    "cbrt": np.cbrt,
    "exp": np.exp,
    "exp2": np.exp2,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "logistic": _logistic,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
}

# Rare operations that NumPy does not have. JAX computes them at once, in about 1 ms.
_BY_JAX: dict[str, Callable[..., Any]] = {
    "bessel_i0e": lax.bessel_i0e,
    "bessel_i1e": lax.bessel_i1e,
    "clz": lax.clz,
    "digamma": lax.digamma,
    "erf": lax.erf,
    "erf_inv": lax.erf_inv,
    "erfc": lax.erfc,
    "igamma": lax.igamma,
    "igamma_grad_a": lax.igamma_grad_a,
    "igammac": lax.igammac,
    "lgamma": lax.lgamma,
    "polygamma": lax.polygamma,
    "population_count": lax.population_count,
    "random_gamma_grad": lax.random_gamma_grad,
    "reduce_precision": lax.reduce_precision,
    "regularized_incomplete_beta": lax.betainc,
    "round": lax.round,
    "shift_right_arithmetic": lax.shift_right_arithmetic,
    "shift_right_logical": lax.shift_right_logical,
    "zeta": lax.zeta,
}
