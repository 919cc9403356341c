"""Elementwise operations: how to run each in JAX and how to fold it in NumPy."""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np
from jax import lax

from mjx_reinforce.fused import jaxprs


@dataclasses.dataclass(frozen=True, slots=True)
class Op:
    """An elementwise operation.

    Attributes:
        name: the primitive's name.
        key: equal for equal operations.
        bind: applies it to JAX values.
        numpy: applies it to NumPy values.
        commutes: whether the operands may change places.
        is_predicate: whether the result is a bool whatever the operands are.
        takes_scalars: whether `bind` broadcasts NumPy scalars itself.
    """

    name: str
    key: Hashable
    bind: Callable[..., Any]
    numpy: Callable[..., Any]
    commutes: bool = False
    is_predicate: bool = False
    takes_scalars: bool = True


def is_constant(value: Any) -> bool:
    """Tells whether a scalar is a constant."""
    return isinstance(value, np.generic)


def fold(op: Op, args: Any, dtype: Any) -> Any:
    """Applies an operation to constants, scalars or arrays, in the equation's own dtype."""
    return np.asarray(op.numpy(*args), dtype)[()]


def conversion(dtype: np.dtype) -> Op:
    """Returns the conversion to a dtype."""
    return Op(
        name="convert_element_type",
        key=("convert_element_type", dtype.str),
        bind=functools.partial(lax.convert_element_type, new_dtype=dtype),
        numpy=lambda x: np.asarray(x).astype(dtype),
    )


def of_equation(eqn: Any) -> Op:
    """Returns the operation of an elementwise equation that has no entry in CORE."""
    primitive, params = eqn.primitive, dict(eqn.params)
    return Op(
        name=primitive.name,
        key=(primitive.name, repr(sorted(params.items()))),
        bind=functools.partial(primitive.bind, **params),
        numpy=lambda *operands: jaxprs.evaluate(primitive, params, list(operands))[0],
        takes_scalars=False,
    )


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


def _core(name: str, bind: Callable, numpy: Callable, **flags: bool) -> Op:
    return Op(name=name, key=name, bind=bind, numpy=numpy, **flags)


SELECT = _core("select_n", lax.select_n, _select, takes_scalars=False)

_COMMUTING = {
    "add": (lax.add, np.add),
    "mul": (lax.mul, np.multiply),
    "max": (lax.max, np.maximum),
    "min": (lax.min, np.minimum),
    "and": (lax.bitwise_and, np.bitwise_and),
    "or": (lax.bitwise_or, np.bitwise_or),
    "xor": (lax.bitwise_xor, np.bitwise_xor),
}
_PREDICATES = {
    "eq": (lax.eq, np.equal),
    "ne": (lax.ne, np.not_equal),
    "lt": (lax.lt, np.less),
    "le": (lax.le, np.less_equal),
    "gt": (lax.gt, np.greater),
    "ge": (lax.ge, np.greater_equal),
    "is_finite": (lax.is_finite, np.isfinite),
}
_OTHERS = {
    "sub": (lax.sub, np.subtract),
    "div": (lax.div, _divide),
    "rem": (lax.rem, np.fmod),
    "pow": (lax.pow, np.power),
    "atan2": (lax.atan2, np.arctan2),
    "nextafter": (lax.nextafter, np.nextafter),
    "shift_left": (lax.shift_left, np.left_shift),
    "neg": (lax.neg, np.negative),
    "not": (lax.bitwise_not, np.invert),
    "abs": (lax.abs, np.abs),
    "sign": (lax.sign, np.sign),
    "floor": (lax.floor, np.floor),
    "ceil": (lax.ceil, np.ceil),
    "sqrt": (lax.sqrt, np.sqrt),
    "rsqrt": (lax.rsqrt, _rsqrt),
    "cbrt": (lax.cbrt, np.cbrt),
    "exp": (lax.exp, np.exp),
    "exp2": (lax.exp2, np.exp2),
    "expm1": (lax.expm1, np.expm1),
    "log": (lax.log, np.log),
    "log1p": (lax.log1p, np.log1p),
    "logistic": (lax.logistic, _logistic),
    "sin": (lax.sin, np.sin),
    "cos": (lax.cos, np.cos),
    "tan": (lax.tan, np.tan),
    "asin": (lax.asin, np.arcsin),
    "acos": (lax.acos, np.arccos),
    "atan": (lax.atan, np.arctan),
    "sinh": (lax.sinh, np.sinh),
    "cosh": (lax.cosh, np.cosh),
    "tanh": (lax.tanh, np.tanh),
    "asinh": (lax.asinh, np.arcsinh),
    "acosh": (lax.acosh, np.arccosh),
    "atanh": (lax.atanh, np.arctanh),
}

CORE = {
    "select_n": SELECT,
    **{name: _core(name, *both, commutes=True) for name, both in _COMMUTING.items()},
    **{name: _core(name, *both, is_predicate=True) for name, both in _PREDICATES.items()},
    **{name: _core(name, *both) for name, both in _OTHERS.items()},
}

# Elementwise primitives that are rare enough to be bound as they are.
GENERIC = frozenset(
    {
        *("bessel_i0e", "bessel_i1e", "clz", "digamma", "erf", "erf_inv", "erfc", "igamma"),
        *("igamma_grad_a", "igammac", "lgamma", "polygamma", "population_count", "round", "zeta"),
        *("random_gamma_grad", "reduce_precision", "regularized_incomplete_beta"),
        *("shift_right_arithmetic", "shift_right_logical"),
    }
)


def any_of(values: Any, reduce: Callable[[jax.Array], jax.Array]) -> Any:
    """Reduces a predicate over lanes; one that all lanes share needs no reduction."""
    return reduce(values) if np.ndim(values) else values
