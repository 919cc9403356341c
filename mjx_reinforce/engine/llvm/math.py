"""The transcendental operations of the scalar graph in LLVM IR.

Those of float32 lanes are ours, but for rare ones; those of float64 lanes are the C library's:
right before fast. Results of float32 below the smallest normal number are
zero, as they are in XLA's threads, and an operand below it counts as zero in ``log``.
"""

import math
from collections.abc import Callable

from mjx_reinforce.engine.llvm.lanes import INFINITY, ROUND_BITS, Lanes

#: What no task and no policy of ours computes with: the C library does, in double precision.
RARE_FUNCTIONS = ("acosh", "asinh", "atanh", "cbrt", "cosh", "erf", "erfc", "exp2", "sinh")
#: The logarithm of 2 in two parts; the first has 9 bits, so that its product with 15 is exact.
_LN2 = (0.693359375, -2.12194440e-4)
#: Beyond these, exp is below 2^-126 and above 2^128.
_EXP_LOW = -87.33654
_EXP_HIGH = 88.72283
#: From here on tanh rounds to 1.
_TANH_IS_1 = 9.02
#: The smallest normal number.
_MIN_NORMAL = 2.0**-126
#: The bits of sqrt(1 / 2).
_SQRT_HALF = 0x3F3504F3
#: In float64: as ``ROUND_BITS``, and the bits of 1 and of sqrt(1 / 2).
_ROUND_64 = 1.5 * 2.0**52
_ONE_64 = 1023 << 52
_SQRT_HALF_64 = 0x3FE6A09E667F3BCD

# Coefficients of polynomials, the highest power first.

#: (exp(x) - 1 - x) / x^2. From Cephes, expf.c.
_EXP_LESS_1 = (
    1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3,
    4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1,
)  # fmt: skip
#: (log(1 + x) - x + x^2 / 2) / x^3. From Cephes, logf.c.
_LOG_SERIES = (
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
    -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
)  # fmt: skip
#: (sin(x) - x) / x^3 and (cos(x) - 1 + x^2 / 2) / x^4, of x^2. From Cephes, sinf.c and cosf.c.
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
#: (atan(x) - x) / x^3, of x^2. From SLEEF, atanf_u35.
_ATAN = (
    0.00282363896258175373, -0.0159569028764963150, 0.0425049886107444763,
    -0.0748900920152664185, 0.106347933411598206, -0.142027363181114197,
    0.199926957488059998, -0.333331018686294556,
)  # fmt: skip
#: (asin(x) - x) / x^3, of x^2. From Cephes, asinf.c.
_ASIN = (4.2163199048e-2, 2.4181311049e-2, 4.5470025998e-2, 7.4953002686e-2, 1.6666752422e-1)
#: erf_inv(x) / x of w = -log(1 - x^2): of w - 2.5 where w < 5, else of sqrt(w) - 3. From M. Giles,
#: Approximating the erfinv function (2012), as in XLA.
_ERF_INV_CENTRAL = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087,
    -0.00125372503, -0.00417768164, 0.246640727, 1.50140941,
)  # fmt: skip
_ERF_INV_TAIL = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773,
    -0.0076224613, 0.00943887047, 1.00167406, 2.83297682,
)  # fmt: skip
#: The same in float64: of w - 3.125 where w < 6.25, of sqrt(w) - 3.25 where w < 16, else of
#: sqrt(w) - 5.
_ERF_INV_CENTRAL_64 = (
    -3.64441206401782e-21, -1.6850591381820166e-19, 1.28584807152564e-18,
    1.1157877678025181e-17, -1.3331716628546209e-16, 2.0972767875968562e-17,
    6.6376381343583238e-15, -4.0545662729752069e-14, -8.1519341976054722e-14,
    2.6335093153082323e-12, -1.2975133253453532e-11, -5.4154120542946279e-11,
    1.0512122733215323e-09, -4.1126339803469837e-09, -2.9070369957882005e-08,
    4.2347877827932404e-07, -1.3654692000834679e-06, -1.3882523362786469e-05,
    0.00018673420803405714, -0.000740702534166267, -0.0060336708714301491,
    0.24015818242558962, 1.6536545626831027,
)  # fmt: skip
_ERF_INV_MIDDLE_64 = (
    2.2137376921775787e-09, 9.0756561938885391e-08, -2.7517406297064545e-07,
    1.8239629214389228e-08, 1.5027403968909828e-06, -4.013867526981546e-06,
    2.9234449089955446e-06, 1.2475304481671779e-05, -4.7318229009055734e-05,
    6.8284851459573175e-05, 2.4031110387097894e-05, -0.00035503752036284748,
    0.0009532893797373805, -0.0016882755560235047, 0.0024914420961078508,
    -0.0037512085075692412, 0.0053709145535900636, 1.0052589676941592,
    3.0838856104922208,
)  # fmt: skip
_ERF_INV_TAIL_64 = (
    -2.7109920616438573e-11, -2.5556418169965252e-10, 1.5076572693500548e-09,
    -3.789465440126737e-09, 7.61570120807834e-09, -1.496002662714924e-08,
    2.9147953450901081e-08, -6.7711997758452339e-08, 2.2900482228026655e-07,
    -9.9298272942317e-07, 4.5260625972231537e-06, -1.9681778105531671e-05,
    7.5995277030017761e-05, -0.00021503011930044477, -0.00013871931833623122,
    1.0103004648645344, 4.8499064014085844,
)  # fmt: skip


def _reduced(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n ln 2, within ln 2 / 2, and integers whose last bits are those of n."""
    sum_bits = x * (1 / math.log(2)) + ROUND_BITS
    n = sum_bits - ROUND_BITS
    # n times the first part of ln 2 does not round; the second part has its further digits.
    return x - n * _LN2[0] - n * _LN2[1], sum_bits.bits()


def _exp_less_1(x: Lanes) -> Lanes:
    """Returns exp(x) - 1 for |x| < 0.4."""
    return x.polynomial(*_EXP_LESS_1) * (x * x) + x


def _power_of_2(n: Lanes, offset: int = 0) -> Lanes:
    """Returns 2^(n + offset) where it is a normal number; only the last bits of n count."""
    return ((n << 23) + (127 + offset << 23)).bits()


def _times_power_of_2(x: Lanes, n: Lanes) -> Lanes:
    """Returns x 2^n where both are normal numbers; only the last bits of n count."""
    return (x.bits() + (n << 23)).bits()


def exp(x: Lanes) -> Lanes:
    """Returns the exponential."""
    remainder, n = _reduced(x)
    power = _times_power_of_2(_exp_less_1(remainder) + 1, n)
    # Beyond these n is no exponent of a normal number. A NaN is not below the least either, and
    # becomes NaN by the product with infinity.
    power = (x < _EXP_LOW).where(0.0, power)
    return (x <= _EXP_HIGH).where(power, x * INFINITY)


def _quarter_of_expm1(x: Lanes) -> Lanes:
    """Returns (exp(x) - 1) / 4, which overflows later."""
    remainder, n = _reduced(x)
    scale = _power_of_2(n, offset=-2)
    return _exp_less_1(remainder) * scale + (scale - 0.25)


def expm1(x: Lanes) -> Lanes:
    """Returns exp(x) - 1."""
    # Below -18 the result rounds to -1, and 2^n would soon be no normal number.
    power_less_1 = _quarter_of_expm1((x < -18.0).where(-18.0, x)) * 4
    # The result has the sign of x; without this, a -0 would become 0.
    return (x <= _EXP_HIGH).where(power_less_1, x * INFINITY).call("copysign", x)


def logistic(x: Lanes) -> Lanes:
    """Returns 1 / (1 + exp(-x))."""
    return 1 / (exp(-x) + 1)


def tanh(x: Lanes) -> Lanes:
    """Returns the hyperbolic tangent: of y = exp(|2 x|) - 1 it is y / (y + 2)."""
    size = (abs(x) > _TANH_IS_1).where(_TANH_IS_1, abs(x))
    remainder, n = _reduced(size * 2)
    scale = _power_of_2(n)
    # y is higher + (scale - 1): near zero, where the scale is 1, it is higher, and loses no digit.
    exp_term = _exp_less_1(remainder) * scale
    return ((exp_term + (scale - 1)) / (exp_term + (scale + 1))).call("copysign", x)


def _log_of_parts(fraction: Lanes, exponent: Lanes) -> Lanes:
    """Returns log((fraction + 1) 2^exponent), sqrt(1 / 2) <= fraction + 1 < sqrt(2)."""
    square = fraction * fraction
    series = fraction.polynomial(*_LOG_SERIES)
    exponent = exponent.convert("sitofp", "float32")
    # Small terms are added first and the largest, n times the first part of ln 2, last: so little
    # is rounded away.
    series = series * (square * fraction) + exponent * _LN2[1]
    return square * -0.5 + series + fraction + exponent * _LN2[0]


def log(x: Lanes) -> Lanes:
    """Returns the natural logarithm."""
    # x / 2^exponent is in [sqrt(1 / 2), sqrt(2)), as the bits of sqrt(1 / 2) are taken away first.
    # So the exponent is 0 around 1, where the logarithm would else be the rest of two larger terms.
    exponent = (x.bits() - _SQRT_HALF) >> 23
    log = _log_of_parts((x.bits() - (exponent << 23)).bits() - 1, exponent)
    log = (x < INFINITY).where(log, x)
    return (x < _MIN_NORMAL).where((x <= -_MIN_NORMAL).where(x.like(math.nan), -INFINITY), log)


def log1p(x: Lanes) -> Lanes:
    """Returns log(1 + x)."""
    exponent = ((x + 1).bits() - _SQRT_HALF) >> 23
    scale = (0x40800000 - (exponent << 23)).bits()  # 4 / 2^exponent
    # (1 + x) / 2^exponent - 1, where 1 and x are divided each, as 1 + x has lost the digits of a
    # small x.
    fraction = (x.bits() - (exponent << 23)).bits() + (scale * 0.25 - 1)
    log = (x < INFINITY).where(_log_of_parts(fraction, exponent), x)
    log = (x > -1.0).where(log, (x < -1.0).where(math.nan, x * INFINITY))
    return log.call("copysign", x)


def erf_inv(x: Lanes) -> Lanes:
    """Returns the inverse of the error function."""
    w = -log1p(x * -x)
    central = (w - 2.5).polynomial(*_ERF_INV_CENTRAL)
    tail = (w.call("sqrt") - 3).polynomial(*_ERF_INV_TAIL)
    inverse = (w < 5).where(central, tail) * x
    # At 1 and -1 w is infinite, and the polynomial would be infinity less infinity.
    return abs(x).compare("eq", 1).where(x * INFINITY, inverse)


def _log2(x: Lanes) -> Lanes:
    """Returns the logarithm to base 2 of x >= 0, float64, to 1e-12; the series of atanh."""
    # As in ``log``: y is x / 2^n in [sqrt(1 / 2), sqrt(2)), and ``biased_exponent`` is n + 1023.
    shifted_bits = x.bits() + (_ONE_64 - _SQRT_HALF_64)
    biased_exponent = shifted_bits.write("lshr", 52)
    y = (x.bits() - (biased_exponent << 52) + _ONE_64).bits()
    ratio = (y - 1) / (y + 1)
    series = (ratio * ratio).polynomial(*(2 / math.log(2) / k for k in range(17, 0, -2)))
    # The bits of 2^52 + biased, since AVX2 has no conversion of integers of 64 bits.
    exponent = (biased_exponent | 0x4330000000000000).bits() - (2.0**52 + 1023)
    log = series * ratio + exponent
    log = x.compare("eq", 0).where(-INFINITY, log)
    return (x < INFINITY).where(log, x)


def _exp2(x: Lanes) -> Lanes:
    """Returns 2^x of |x| <= 300, float64, to 1e-12; the series."""
    sum_bits = x + _ROUND_64
    remainder = x - (sum_bits - _ROUND_64)
    powers = range(10, -1, -1)
    series = remainder.polynomial(*(math.log(2) ** k / math.factorial(k) for k in powers))
    return series * ((sum_bits.bits() + 1023) << 52).bits()


def pow(x: Lanes, y: Lanes) -> Lanes:
    """Returns x^y, as C does, through float64."""
    size = abs(x)
    log = _log2(size.convert("fpext", "float64"))
    # C has 1 for an |x| of 1 also where y is infinite: there the product would be NaN.
    product = size.compare("eq", 1).where(0.0, log * y.convert("fpext", "float64"))
    # 2^300 and 2^-300 are infinity and zero in float32; two comparisons let a NaN pass.
    product = (product > 300.0).where(300.0, product)
    product = (product < -300.0).where(-300.0, product)
    power = _exp2(product).convert("fptrunc", "float32")
    # The power of a negative x is negative where y is odd, and NaN where y is not an integer.
    is_whole = y.call("floor").compare("eq", y)
    half = y * 0.5
    is_odd = is_whole & half.call("floor").compare("ne", half)
    power = is_odd.where(power.call("copysign", x), power)
    power = ((x < 0.0) & (x > -INFINITY) & is_whole.compare("eq", False)).where(math.nan, power)
    return (y.compare("eq", 0) | x.compare("eq", 1)).where(1.0, power)


#: pi / 2 in three parts; the first has 8 bits, so that its product with 16 bits is exact.
_HALF_PI = (1.5703125, 0.0004838267923332751, 2.5633440682570896e-12)
#: Up to here the three parts leave an error below 1e-6, with fused operations below 1e-9.
_LARGE_ANGLE = 1e5
_SIGN = -(2**31)
#: The first 192 binary digits of 2^-8 / (2 pi).
_TURN_DIGITS = (0x0028BE60DB939105, 0x4A7F09D5F47D4D37, 0x7036D8A5664F10E4)
#: pi / 2 less its float32.
_HALF_PI_LOW = -4.371139000186241e-08


def _large(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n pi / 2 within pi / 4 and the last bits of the integer n, for x > _LARGE_ANGLE.

    After Payne and Hanek: x is an integer of 24 bits times 2^e, and of its product with
    1 / (2 pi) what is not a whole turn is in the 64 digits that start at digit e.
    """
    bits = x.bits()
    # The mantissa with its leading 1, and at which digit of 1 / (2 pi) the product begins to count.
    mantissa = ((bits & 0x7FFFFF) | 0x800000).convert("zext", "int64")
    start = ((bits >> 23) - (127 + 23 - 8)).convert("zext", "int64")
    low, middle, high = (start.like(digits) for digits in _TURN_DIGITS)
    is_first = start < 64
    turn = mantissa * is_first.where(low, middle).call("fshl", is_first.where(middle, high), start)
    # A whole turn is 2^64 here, and wraps around; a quarter is 2^62. Half a quarter rounds n.
    n = (turn + 2**61) >> 62
    # The 32 highest bits of what is left are more than float32 holds.
    fraction = ((turn - (n << 62)) >> 32).convert("trunc", "int32").convert("sitofp", "float32")
    remainder = (x < INFINITY).where(fraction * (6.283185307179586 / 2**32), math.nan)
    return remainder, n.convert("trunc", "int32")


def _reduce_angle(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n pi / 2 within pi / 4 and the last bits of the integer n, for x >= 0."""
    sum_bits = x * (2 / 3.141592653589793) + ROUND_BITS
    n = sum_bits - ROUND_BITS
    small_pair = (x - n * _HALF_PI[0] - n * _HALF_PI[1] - n * _HALF_PI[2], sum_bits.bits())
    is_large = x > _LARGE_ANGLE
    entry = x.text.block
    # Large angles are rare and take many operations: a branch that runs if some lane needs it.
    with x.text.when(x.text.any(is_large.name)):
        large_pair = [is_large.where(*pair) for pair in zip(_large(x), small_pair, strict=True)]
        branch = x.text.block
    remainder, n = (
        low_turn.named(x.text.phi(low_turn.dtype, {entry: low_turn.name, branch: high_turn.name}))
        for low_turn, high_turn in zip(small_pair, large_pair, strict=True)
    )
    return remainder, n


def _sine_and_cosine(x: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """Returns sine and cosine of |x| - n pi / 2, within pi / 4, and the last bits of n."""

    def write() -> tuple[Lanes, Lanes, Lanes]:
        """Writes what sine, cosine and tangent of one angle share."""
        remainder, n = _reduce_angle(abs(x))
        square = remainder * remainder
        sine = square.polynomial(*_SINE)
        cosine = square.polynomial(*_COSINE)
        sine = sine * (square * remainder) + remainder
        cosine = cosine * (square * square) + (square * -0.5 + 1)
        return sine, cosine, n

    # A rotation takes both of one angle.
    return x.text.once(("sine and cosine", x.name), write)


def sin(x: Lanes) -> Lanes:
    """Returns the sine."""
    sine, cosine, n = _sine_and_cosine(x)
    # An odd number of quarter turns swaps sine and cosine. Two of them change the sign: bit 1 of n
    # is shifted to the sign's place.
    size = ((n & 1).compare("eq", 0)).where(sine, cosine)
    return (size.bits() ^ ((x.bits() ^ (n << 30)) & _SIGN)).bits()


def cos(x: Lanes) -> Lanes:
    """Returns the cosine."""
    sine, cosine, n = _sine_and_cosine(x)
    size = ((n & 1).compare("eq", 0)).where(cosine, sine)
    return (size.bits() ^ (((n + 1) << 30) & _SIGN)).bits()


def tan(x: Lanes) -> Lanes:
    """Returns the tangent."""
    sine, cosine, n = _sine_and_cosine(x)
    is_even = (n & 1).compare("eq", 0)
    size = is_even.where(sine, cosine) / is_even.where(cosine, sine)
    return (size.bits() ^ ((x.bits() ^ (n << 31)) & _SIGN)).bits()


def _quarter_less(arc: Lanes) -> Lanes:
    """Returns pi / 2 - arc."""
    return math.pi / 2 - arc + _HALF_PI_LOW


def _atan_to_1(x: Lanes) -> Lanes:
    """Returns the arctangent of 0 <= x <= 1."""
    square = x * x
    return square.polynomial(*_ATAN) * (square * x) + x


def atan(x: Lanes) -> Lanes:
    """Returns the arctangent."""
    size = abs(x)
    is_above_1 = size > 1.0
    arc = _atan_to_1(is_above_1.where(1 / size, size))
    return is_above_1.where(_quarter_less(arc), arc).call("copysign", x)


def atan2(y: Lanes, x: Lanes) -> Lanes:
    """Returns the angle of the point (x, y), as C does."""
    height = abs(y)
    width = abs(x)
    is_steep = height > width
    short_side = is_steep.where(width, height)
    long_side = is_steep.where(height, width)
    # C has an angle also where both are infinite or both are zero, where their ratio is NaN.
    ratio = short_side.compare("eq", long_side).where(1.0, short_side / long_side)
    ratio = short_side.compare("eq", 0).where(0.0, ratio)
    arc = _atan_to_1(ratio)
    arc = is_steep.where(_quarter_less(arc), arc)
    # By the bit of the sign, as C tells the angle of x = -0 from that of 0.
    arc = (x.bits() < 0).where(math.pi - arc, arc).call("copysign", y)
    return (height + width).compare("eq", height + width).where(arc, math.nan)


def _asin_parts(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns for x >= 0 whether x > 1 / 2, and asin(x), there asin(sqrt((1 - x) / 2))."""
    is_great = x > 0.5
    square = is_great.where((1 - x) * 0.5, x * x)
    root = is_great.where(square.call("sqrt"), x)
    return is_great, square.polynomial(*_ASIN) * (square * root) + root


def asin(x: Lanes) -> Lanes:
    """Returns the arcsine."""
    is_great, arc = _asin_parts(abs(x))
    return is_great.where(_quarter_less(arc * 2), arc).call("copysign", x)


def acos(x: Lanes) -> Lanes:
    """Returns the arccosine."""
    is_great, arc = _asin_parts(abs(x))
    obtuse_arc = (x < 0.0).where(math.pi - arc * 2, arc * 2)
    return is_great.where(obtuse_arc, math.pi / 2 - arc.call("copysign", x))


def _library(name: str) -> Callable[..., Lanes]:
    """Returns what calls a function of the C library for each lane."""

    def write(*operands: Lanes) -> Lanes:
        """Calls the function on scalars: it has no form for vectors."""
        text = operands[0].text
        kind = text.type(operands[0].dtype)
        arg_types = ", ".join(["double"] * len(operands))
        text.declared.add(f"declare double @{name}({arg_types})")
        vector = "poison"
        for lane in range(text.lanes):
            index = f"i64 {lane}"
            scalars = [text.let(f"extractelement {kind} {x.name}, {index}") for x in operands]
            arguments = ", ".join(f"double {x}" for x in scalars)
            value = text.let(f"call double @{name}({arguments})")
            vector = text.let(f"insertelement {kind} {vector}, double {value}, {index}")
        return operands[0].named(vector)

    return write


def _rounded(name: str) -> Callable[..., Lanes]:
    """Returns what calls a function of the C library for each lane of float32."""
    call = _library(name)
    return lambda x: call(x.convert("fpext", "float64")).convert("fptrunc", "float32")


def _logistic(x: Lanes) -> Lanes:
    """Returns 1 / (1 + exp(-x))."""
    return 1 / (_library("exp")(-x) + 1)


def _erf_inv(x: Lanes) -> Lanes:
    """Returns the inverse of the error function."""
    w = -_library("log1p")(x * -x)
    root = w.call("sqrt")
    central = (w - 3.125).polynomial(*_ERF_INV_CENTRAL_64)
    middle_value = (root - 3.25).polynomial(*_ERF_INV_MIDDLE_64)
    tail = (root - 5).polynomial(*_ERF_INV_TAIL_64)
    inverse = (w < 6.25).where(central, (w < 16.0).where(middle_value, tail)) * x
    return abs(x).compare("eq", 1).where(x * INFINITY, inverse)


_ANGLE_FUNCTIONS = (acos, asin, atan, atan2, cos, sin, tan)
_POWER_FUNCTIONS = (erf_inv, exp, expm1, log, log1p, logistic, pow, tanh)
#: name of the operation -> (operands of float32) -> the result
_FLOAT32: dict[str, Callable[..., Lanes]] = {
    **{name: _rounded(name) for name in RARE_FUNCTIONS},
    **{function.__name__: function for function in (*_ANGLE_FUNCTIONS, *_POWER_FUNCTIONS)},
}
#: What the C library does not have as functions of doubles.
_FLOAT64: dict[str, Callable[..., Lanes]] = {"erf_inv": _erf_inv, "logistic": _logistic}
#: dtype -> name of the operation -> (operands) -> the result
FUNCTIONS: dict[str, dict[str, Callable[..., Lanes]]] = {
    "float32": _FLOAT32,
    "float64": {name: _FLOAT64.get(name) or _library(name) for name in _FLOAT32},
}
