"""The operations of the scalar graph: the one table of their names, and of how each is computed.

JAX computes an operation on lanes, NumPy computes it on constants. ``folding`` lists what NumPy has
no one function for, and a backend that does not go through JAX lists what it writes instead.
"""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np


class Op(NamedTuple):
    """An elementwise operation. Equal operations are equal tuples.

    name: a name of ``FACTS``; mostly that of a JAX primitive.
    params: its parameters by name, sorted; few operations have any.
    """

    name: str
    params: tuple[tuple[str, Hashable], ...] = ()


class Facts(NamedTuple):
    """What is known of a name.

    in_numpy: operands -> result; None where NumPy has no one function for it.
    in_jax: the name of a function of ``jax.lax``, (operands, **parameters) -> result; "" where
      that is the name of the operation.
    arity: how many operands it takes; ``select_n`` takes a number of a case and the cases.
    commutes: whether two operands may change places.
    is_predicate: whether the result is a bool whatever the operands are.
    has_params: whether the parameters of the JAX primitive are part of the operation.
    """

    in_numpy: Callable[..., Any] | None = None
    in_jax: str = ""
    arity: int = 1
    commutes: bool = False
    is_predicate: bool = False
    has_params: bool = False


def _named(*names: str, **facts: Any) -> dict[str, Facts]:
    """Returns the facts of operations that NumPy has under the same names."""
    return {name: Facts(getattr(np, name), **facts) for name in names}


#: Every operation that a rule can make.
FACTS: dict[str, Facts] = {
    "add": Facts(np.add, arity=2, commutes=True),
    "mul": Facts(np.multiply, arity=2, commutes=True),
    "max": Facts(np.maximum, arity=2, commutes=True),
    "min": Facts(np.minimum, arity=2, commutes=True),
    "and": Facts(np.bitwise_and, in_jax="bitwise_and", arity=2, commutes=True),
    "or": Facts(np.bitwise_or, in_jax="bitwise_or", arity=2, commutes=True),
    "xor": Facts(np.bitwise_xor, in_jax="bitwise_xor", arity=2, commutes=True),
    "eq": Facts(np.equal, arity=2, is_predicate=True),
    "ne": Facts(np.not_equal, arity=2, is_predicate=True),
    "lt": Facts(np.less, arity=2, is_predicate=True),
    "le": Facts(np.less_equal, arity=2, is_predicate=True),
    "gt": Facts(np.greater, arity=2, is_predicate=True),
    "ge": Facts(np.greater_equal, arity=2, is_predicate=True),
    "is_finite": Facts(np.isfinite, is_predicate=True),
    "select_n": Facts(arity=3),
    "sub": Facts(np.subtract, arity=2),
    "div": Facts(arity=2),
    "rem": Facts(arity=2),
    "pow": Facts(np.power, arity=2),
    "atan2": Facts(np.arctan2, arity=2),
    "nextafter": Facts(np.nextafter, arity=2),
    "shift_left": Facts(np.left_shift, arity=2),
    "neg": Facts(np.negative),
    "not": Facts(np.invert, in_jax="bitwise_not"),
    **_named("abs", "sign", "floor", "ceil", "sqrt", "cbrt", "exp", "exp2", "expm1"),
    **_named("log", "log1p", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    **{f"a{name}": Facts(getattr(np, f"arc{name}")) for name in ("sin", "cos", "tan")},
    **{f"a{name}": Facts(getattr(np, f"arc{name}")) for name in ("sinh", "cosh", "tanh")},
    **dict.fromkeys(("rsqrt", "logistic"), Facts()),
    **dict.fromkeys(("erf", "erf_inv", "erfc", "round"), Facts(has_params=True)),
    **dict.fromkeys(("clz", "population_count", "reduce_precision"), Facts(has_params=True)),
    **dict.fromkeys(("convert_element_type", "bitcast_convert_type"), Facts(has_params=True)),
    "shift_right_arithmetic": Facts(arity=2, has_params=True),
    "shift_right_logical": Facts(arity=2, has_params=True),
}

SELECT = Op("select_n")


def conversion(dtype: np.dtype) -> Op:
    """Returns the conversion to a dtype."""
    return Op("convert_element_type", (("new_dtype", dtype),))
