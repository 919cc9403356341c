"""Exponentials, logarithms, error functions and powers of float32 lanes.

Results below the smallest normal number are zero, as they are in XLA's threads, and an operand
below it counts as zero in ``log``.
"""

import math

from mjx_reinforce.engine.llvm.lanes import INFINITY, ROUND, Lanes

#: The logarithm of 2 in two parts; the first has 9 bits, so that its product with 15 is exact.
_LN2 = (0.693359375, -2.12194440e-4)
#: Beyond these, exp is below 2^-126 and above 2^128.
_LEAST, _GREATEST = -87.33654, 88.72283
#: From here on tanh rounds to 1.
_TANH_IS_1 = 9.02
#: The smallest normal number, and the bits of sqrt(1 / 2).
_SMALLEST, _SQRT_HALF = 2.0**-126, 0x3F3504F3
#: In float64: as ROUND, and the bits of 1 and of sqrt(1 / 2).
_ROUND_64, _ONE_64, _SQRT_HALF_64 = 1.5 * 2.0**52, 1023 << 52, 0x3FE6A09E667F3BCD


def _reduced(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n ln 2, within ln 2 / 2, and integers whose last bits are those of n."""
    rounded = x * (1 / math.log(2)) + ROUND
    n = rounded - ROUND
    return x - n * _LN2[0] - n * _LN2[1], rounded.bits()


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
    higher = higher * (square * less_1) + exponent * _LN2[1]
    return square * -0.5 + higher + less_1 + exponent * _LN2[0]


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
    above = x.bits() + (_ONE_64 - _SQRT_HALF_64)
    biased = above.write("lshr", 52)
    y = (x.bits() - (biased << 52) + _ONE_64).bits()
    ratio = (y - 1) / (y + 1)
    series = (ratio * ratio).polynomial(*(2 / math.log(2) / k for k in range(17, 0, -2)))
    exponent = (biased | 0x4330000000000000).bits() - (2.0**52 + 1023)  # 2^52 + biased
    result = series * ratio + exponent
    result = x.compare("eq", 0).where(-INFINITY, result)
    return (x < INFINITY).where(result, x)


def _exp2(x: Lanes) -> Lanes:
    """Returns 2^x of |x| <= 300, float64, to 1e-12; the series."""
    rounded = x + _ROUND_64
    rest = x - (rounded - _ROUND_64)
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
