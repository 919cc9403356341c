"""The transcendental operations of the scalar graph in LLVM IR."""

from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.fused.backends import (
    llvm_exponential,
    llvm_float64,
    llvm_inverse_trigonometry,
    llvm_logarithm,
    llvm_special,
    llvm_trigonometry,
)
from mjx_reinforce.fused.backends.llvm_lanes import Lanes
from mjx_reinforce.fused.backends.llvm_text import Text

#: What no task and no policy of ours computes with: the C library does, in double precision.
RARE = ("acosh", "asinh", "atanh", "cbrt", "cosh", "erfc", "exp2", "sinh")
_FLOAT32: dict[str, Callable[..., Lanes]] = {
    **{name: llvm_float64.rounded(name) for name in RARE},
    "acos": llvm_inverse_trigonometry.acos,
    "asin": llvm_inverse_trigonometry.asin,
    "atan": llvm_inverse_trigonometry.atan,
    "atan2": llvm_inverse_trigonometry.atan2,
    "cos": llvm_trigonometry.cos,
    "erf": llvm_special.erf,
    "erf_inv": llvm_special.erf_inv,
    "exp": llvm_exponential.exp,
    "expm1": llvm_exponential.expm1,
    "log": llvm_logarithm.log,
    "log1p": llvm_logarithm.log1p,
    "logistic": llvm_exponential.logistic,
    "pow": llvm_special.pow,
    "sin": llvm_trigonometry.sin,
    "tan": llvm_trigonometry.tan,
    "tanh": llvm_exponential.tanh,
}
_FLOAT64: dict[str, Callable[..., Lanes]] = {
    **{name: llvm_float64.library(name) for name in llvm_float64.LIBRARY},
    "erf_inv": llvm_float64.erf_inv,
    "logistic": llvm_float64.logistic,
}
_OF_DTYPE = {"float32": _FLOAT32, "float64": _FLOAT64}


def _on_lanes(name: str) -> Callable[..., str]:
    def write(text: Text, dtype: DTypeLike, *operands: str) -> str:
        lanes = [Lanes(text, np.dtype(dtype), x) for x in operands]
        return _OF_DTYPE[np.dtype(dtype).name][name](*lanes).name

    return write


#: name of the operation -> (where to write, float32 or float64, operands) -> the result
FUNCTIONS: dict[str, Callable[..., str]] = {name: _on_lanes(name) for name in _FLOAT32}
