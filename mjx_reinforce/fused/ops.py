"""The operations of the scalar graph: their names, and what is known of each name.

How an operation is computed is not said here. `folding` computes it on constants, each backend on
everything else.
"""

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np


class Op(NamedTuple):
    """An elementwise operation. Equal operations are equal tuples.

    Attributes:
        name: a name of `FACTS`; mostly that of a JAX primitive.
        params: its parameters by name, sorted; few operations have any.
    """

    name: str
    params: tuple[tuple[str, Hashable], ...] = ()


class Facts(NamedTuple):
    """What is known of a name.

    Attributes:
        commutes: whether two operands may change places.
        is_predicate: whether the result is a bool whatever the operands are.
        has_params: whether the parameters of the JAX primitive are part of the operation.
    """

    commutes: bool = False
    is_predicate: bool = False
    has_params: bool = False


_COMMUTING = ("add", "mul", "max", "min", "and", "or", "xor")
_PREDICATES = ("eq", "ne", "lt", "le", "gt", "ge", "is_finite")
_OTHERS = (
    *("select_n", "sub", "div", "rem", "pow", "atan2", "nextafter", "shift_left", "neg", "not"),
    *("abs", "sign", "floor", "ceil", "sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1", "log"),
    *("log1p", "logistic", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("asinh", "acosh", "atanh"),
)
_WITH_PARAMS = (
    *(
        "convert_element_type",
        "bitcast_convert_type",
        "bessel_i0e",
        "bessel_i1e",
        "clz",
        "digamma",
        "erf",
        "erf_inv",
    ),
    *("erfc", "igamma", "igamma_grad_a", "igammac", "lgamma", "polygamma", "population_count"),
    *("round", "zeta", "random_gamma_grad", "reduce_precision", "regularized_incomplete_beta"),
    *("shift_right_arithmetic", "shift_right_logical"),
)

#: Every operation that a rule can make.
FACTS: dict[str, Facts] = {
    **dict.fromkeys(_COMMUTING, Facts(commutes=True)),
    **dict.fromkeys(_PREDICATES, Facts(is_predicate=True)),
    **dict.fromkeys(_OTHERS, Facts()),
    **dict.fromkeys(_WITH_PARAMS, Facts(has_params=True)),
}

SELECT = Op("select_n")


def conversion(dtype: np.dtype) -> Op:
    """Returns the conversion to a dtype."""
    return Op("convert_element_type", (("new_dtype", dtype),))
