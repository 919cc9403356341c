"""Exponentials and the hyperbolic tangent of float32 lanes.

Results below the smallest normal number are zero, as they are in XLA's threads.
"""

import math

from mjx_reinforce.fused.backends.llvm_lanes import INFINITY, ROUND, Lanes

#: The logarithm of 2 in two parts; the first has 9 bits, so that its product with 15 is exact.
LN2 = (0.693359375, -2.12194440e-4)
#: Beyond these, exp is below 2^-126 and above 2^128.
_LEAST, _GREATEST = -87.33654, 88.72283
#: From here on tanh rounds to 1.
_TANH_IS_1 = 9.02


def _reduced(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n ln 2, within ln 2 / 2, and integers whose last bits are those of n."""
    rounded = x * (1 / math.log(2)) + ROUND
    n = rounded - ROUND
    return x - n * LN2[0] - n * LN2[1], rounded.bits()


def _exp_less_1(x: Lanes) -> Lanes:
    """Returns exp(x) - 1 for |x| < 0.4. Coefficients: Cephes, expf.c."""
    higher = x.polynomial(
        *(1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3),
        *(4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1),
    )
    return higher * (x * x) + x


def _power_of_2(n: Lanes, offset: int = 0) -> Lanes:
    """Returns 2^(n + offset) where it is a normal number; only the last bits of n count."""
    return ((n << 23) + (127 + offset << 23)).bits()


def _times_power_of_2(x: Lanes, n: Lanes) -> Lanes:
    """Returns x 2^n where both are normal numbers; only the last bits of n count."""
    return (x.bits() + (n << 23)).bits()


def exp(x: Lanes, less: Lanes | None = None) -> Lanes:
    """Returns the exponential of x, or of x - less, where |less| < 0.05."""
    rest, n = _reduced(x)
    rest = rest if less is None else rest - less
    result = _times_power_of_2(_exp_less_1(rest) + 1, n)
    result = (x < _LEAST).where(0.0, result)
    return (x <= _GREATEST).where(result, x * INFINITY)  # infinity or NaN


def _quarter_of_expm1(x: Lanes) -> Lanes:
    """Returns (exp(x) - 1) / 4, which overflows later."""
    rest, n = _reduced(x)
    scale = _power_of_2(n, offset=-2)
    return _exp_less_1(rest) * scale + (scale - 0.25)


def expm1(x: Lanes) -> Lanes:
    """Returns exp(x) - 1."""
    result = _quarter_of_expm1((x < -18.0).where(-18.0, x)) * 4
    return (x <= _GREATEST).where(result, x * INFINITY).call("copysign", x)


def logistic(x: Lanes) -> Lanes:
    """Returns 1 / (1 + exp(-x))."""
    return 1 / (exp(-x) + 1)


def tanh(x: Lanes) -> Lanes:
    """Returns the hyperbolic tangent: of y = exp(|2 x|) - 1 it is y / (y + 2)."""
    size = (abs(x) > _TANH_IS_1).where(_TANH_IS_1, abs(x))
    rest, n = _reduced(size * 2)
    scale = _power_of_2(n)
    higher = _exp_less_1(rest) * scale
    return ((higher + (scale - 1)) / (higher + (scale + 1))).call("copysign", x)
