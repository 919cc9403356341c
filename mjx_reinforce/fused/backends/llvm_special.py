"""Error functions and powers of float32 lanes."""

import math

from mjx_reinforce.fused.backends.llvm_exponential import exp
from mjx_reinforce.fused.backends.llvm_lanes import INFINITY, Lanes
from mjx_reinforce.fused.backends.llvm_logarithm import log1p

_ROUND = 1.5 * 2.0**52
#: The bits of 1 and of sqrt(1 / 2) in float64.
_ONE, _SQRT_HALF = 1023 << 52, 0x3FE6A09E667F3BCD


def _erf_near_0(x: Lanes) -> Lanes:
    """Returns the error function for |x| < 1 / 2. Coefficients: minimax, fitted by us to 1.4e-9."""
    higher = (x * x).polynomial(
        *(0.0047179897799228826, -0.026757184144224241, 0.11282822808591147),
        *(-0.37612608572861744, 0.1283791655673648),
    )
    return higher * x + x


def _erfc_of_greater(x: Lanes) -> Lanes:
    """Returns 1 - erf(x) for x > 1 / 2: exp(-x^2) by a rational function, fitted by us to 1e-9."""
    x = (x > 10.1).where(10.1, x)
    above = x.polynomial(
        *(0.043689161344163209, 0.27346242694504136, 0.81809309172995566),
        *(1.3140095917051087, 1.0000099372629862),
    )
    below = x.polynomial(
        *(0.077436738058146783, 0.48471147468597858, 1.488531496149020),
        *(2.5737118139924751, 2.4424857004448279, 1),
    )
    high = (x.bits() & ~0xFFF).bits()  # its square is exact
    return exp(-high * high, less=(x - high) * (x + high)) * (above / below)


def erf(x: Lanes) -> Lanes:
    """Returns the error function."""
    size = abs(x)
    far = (1 - _erfc_of_greater(size)).call("copysign", x)
    return (size < 0.5).where(_erf_near_0(x), far)


def erf_inv(x: Lanes) -> Lanes:
    """Returns the inverse of the error function.

    Coefficients: M. Giles, Approximating the erfinv function (2012), as in XLA.
    """
    w = -log1p(x * -x)
    central = (w - 2.5).polynomial(
        *(2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087),
        *(-0.00125372503, -0.00417768164, 0.246640727, 1.50140941),
    )
    tail = (w.call("sqrt") - 3).polynomial(
        *(-0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773),
        *(-0.0076224613, 0.00943887047, 1.00167406, 2.83297682),
    )
    result = (w < 5).where(central, tail) * x
    return abs(x).compare("eq", 1).where(x * INFINITY, result)


def _log2(x: Lanes) -> Lanes:
    """Returns the logarithm to base 2 of x >= 0, float64, to 1e-12; the series of atanh."""
    above = x.bits() + (_ONE - _SQRT_HALF)
    biased = above.write("lshr", 52)
    y = (x.bits() - (biased << 52) + _ONE).bits()
    ratio = (y - 1) / (y + 1)
    series = (ratio * ratio).polynomial(*(2 / math.log(2) / k for k in range(17, 0, -2)))
    exponent = (biased | 0x4330000000000000).bits() - (2.0**52 + 1023)  # 2^52 + biased
    result = series * ratio + exponent
    result = x.compare("eq", 0).where(-INFINITY, result)
    return (x < INFINITY).where(result, x)


def _exp2(x: Lanes) -> Lanes:
    """Returns 2^x of |x| <= 300, float64, to 1e-12; the series."""
    rounded = x + _ROUND
    rest = x - (rounded - _ROUND)
    series = rest.polynomial(*(math.log(2) ** k / math.factorial(k) for k in range(10, -1, -1)))
    return series * ((rounded.bits() + 1023) << 52).bits()


def pow(x: Lanes, y: Lanes) -> Lanes:
    """Returns x^y, as C does, through float64."""
    size = abs(x)
    log = _log2(size.convert("fpext", "float64"))
    product = size.compare("eq", 1).where(0.0, log * y.convert("fpext", "float64"))
    product = (product > 300.0).where(300.0, product)
    product = (product < -300.0).where(-300.0, product)
    result = _exp2(product).convert("fptrunc", "float32")
    whole, half = y.call("floor").compare("eq", y), y * 0.5
    is_odd = whole & half.call("floor").compare("ne", half)
    result = is_odd.where(result.call("copysign", x), result)
    result = ((x < 0.0) & (x > -INFINITY) & whole.compare("eq", False)).where(math.nan, result)
    return (y.compare("eq", 0) | x.compare("eq", 1)).where(1.0, result)
