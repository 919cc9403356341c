"""Logarithms of float32 lanes.

An operand below the smallest normal number counts as zero in ``log``, as it does in XLA's threads.
"""

import math

from mjx_reinforce.fused.backends.llvm_exponential import LN2
from mjx_reinforce.fused.backends.llvm_lanes import INFINITY, Lanes

_SMALLEST = 2.0**-126
_SQRT_HALF = 0x3F3504F3  # the bits of sqrt(1 / 2)


def _log_of_parts(less_1: Lanes, exponent: Lanes) -> Lanes:
    """Returns log((less_1 + 1) 2^exponent), sqrt(1 / 2) <= less_1 + 1 < sqrt(2).

    Coefficients: Cephes, logf.c.
    """
    square = less_1 * less_1
    higher = less_1.polynomial(
        *(7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1),
        *(-1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1),
    )
    exponent = exponent.convert("sitofp", "float32")
    higher = higher * (square * less_1) + exponent * LN2[1]
    return square * -0.5 + higher + less_1 + exponent * LN2[0]


def log(x: Lanes) -> Lanes:
    """Returns the natural logarithm."""
    exponent = (x.bits() - _SQRT_HALF) >> 23
    result = _log_of_parts((x.bits() - (exponent << 23)).bits() - 1, exponent)
    result = (x < INFINITY).where(result, x)
    return (x < _SMALLEST).where((x <= -_SMALLEST).where(x.like(math.nan), -INFINITY), result)


def log1p(x: Lanes) -> Lanes:
    """Returns log(1 + x)."""
    exponent = ((x + 1).bits() - _SQRT_HALF) >> 23
    scale = (0x40800000 - (exponent << 23)).bits()  # 4 / 2^exponent
    less_1 = (x.bits() - (exponent << 23)).bits() + (scale * 0.25 - 1)
    result = (x < INFINITY).where(_log_of_parts(less_1, exponent), x)
    result = (x > -1.0).where(result, (x < -1.0).where(math.nan, x * INFINITY))
    return result.call("copysign", x)
