"""Sine, cosine and tangent of float32 lanes, and their inverses."""

import math

from mjx_reinforce.engine.llvm.lanes import ROUND, Lanes

#: pi / 2 in three parts; the first has 8 bits, so that its product with 16 bits is exact.
_HALF_PI = (1.5703125, 0.0004838267923332751, 2.5633440682570896e-12)
#: Up to here the three parts leave an error below 1e-6, with fused operations below 1e-9.
_LARGE_ANGLE = 1e5
_SIGN = -(2**31)
#: The first 192 binary digits of 2^-8 / (2 pi).
_TURN = (0x0028BE60DB939105, 0x4A7F09D5F47D4D37, 0x7036D8A5664F10E4)
#: pi / 2 less its float32.
_HALF_PI_LOW = -4.371139000186241e-08


def _large(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n pi / 2 within pi / 4 and the last bits of the integer n, for x > _LARGE_ANGLE.

    After Payne and Hanek: x is an integer of 24 bits times 2^e, and of its product with
    1 / (2 pi) what is not a whole turn is in the 64 digits that start at digit e.
    """
    bits = x.bits()
    integer = ((bits & 0x7FFFFF) | 0x800000).convert("zext", "int64")
    start = ((bits >> 23) - (127 + 23 - 8)).convert("zext", "int64")
    low, middle, high = (start.like(digits) for digits in _TURN)
    first = start < 64
    turn = integer * first.where(low, middle).call("fshl", first.where(middle, high), start)
    n = (turn + 2**61) >> 62
    rest = ((turn - (n << 62)) >> 32).convert("trunc", "int32").convert("sitofp", "float32")
    rest = (x < float("inf")).where(rest * (6.283185307179586 / 2**32), float("nan"))
    return rest, n.convert("trunc", "int32")


def _reduce_angle(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns x - n pi / 2 within pi / 4 and the last bits of the integer n, for x >= 0."""
    rounded = x * (2 / 3.141592653589793) + ROUND
    n = rounded - ROUND
    small = x - n * _HALF_PI[0] - n * _HALF_PI[1] - n * _HALF_PI[2], rounded.bits()
    is_large = x > _LARGE_ANGLE
    before = x.text.block
    with x.text.unless_none(is_large.name):
        large = [is_large.where(*pair) for pair in zip(_large(x), small, strict=True)]
        inside = x.text.block
    rest, n = (
        a.named(x.text.phi(a.dtype, {before: a.name, inside: b.name}))
        for a, b in zip(small, large, strict=True)
    )
    return rest, n


def _sine_and_cosine(x: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """Returns sine and cosine of |x| - n pi / 2, within pi / 4, and the last bits of n."""

    def write() -> tuple[Lanes, Lanes, Lanes]:
        rest, n = _reduce_angle(abs(x))
        square = rest * rest
        # Cephes, sinf.c and cosf.c.
        sine = square.polynomial(-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
        cosine = square.polynomial(
            2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2
        )
        sine = sine * (square * rest) + rest
        return sine, cosine * (square * square) + (square * -0.5 + 1), n

    return x.text.once(("sine and cosine", x.name), write)


def sin(x: Lanes) -> Lanes:
    """Returns the sine."""
    sine, cosine, n = _sine_and_cosine(x)
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
    """Returns the arctangent of 0 <= x <= 1. Coefficients: SLEEF, atanf_u35."""
    square = x * x
    higher = square.polynomial(
        *(0.00282363896258175373, -0.0159569028764963150, 0.0425049886107444763),
        *(-0.0748900920152664185, 0.106347933411598206, -0.142027363181114197),
        *(0.199926957488059998, -0.333331018686294556),
    )
    return higher * (square * x) + x


def atan(x: Lanes) -> Lanes:
    """Returns the arctangent."""
    size = abs(x)
    is_above_1 = size > 1.0
    arc = _atan_to_1(is_above_1.where(1 / size, size))
    return is_above_1.where(_quarter_less(arc), arc).call("copysign", x)


def atan2(y: Lanes, x: Lanes) -> Lanes:
    """Returns the angle of the point (x, y), as C does."""
    height, width = abs(y), abs(x)
    is_steep = height > width
    less, more = is_steep.where(width, height), is_steep.where(height, width)
    ratio = less.compare("eq", more).where(1.0, less / more)
    ratio = less.compare("eq", 0).where(0.0, ratio)
    arc = _atan_to_1(ratio)
    arc = is_steep.where(_quarter_less(arc), arc)
    arc = (x.bits() < 0).where(math.pi - arc, arc).call("copysign", y)
    return (height + width).compare("eq", height + width).where(arc, math.nan)


def _asin_parts(x: Lanes) -> tuple[Lanes, Lanes]:
    """Returns for x >= 0 whether x > 1 / 2, and asin(x), there asin(sqrt((1 - x) / 2)).

    Coefficients: Cephes, asinf.c.
    """
    is_great = x > 0.5
    square = is_great.where((1 - x) * 0.5, x * x)
    root = is_great.where(square.call("sqrt"), x)
    higher = square.polynomial(
        *(4.2163199048e-2, 2.4181311049e-2, 4.5470025998e-2, 7.4953002686e-2, 1.6666752422e-1)
    )
    return is_great, higher * (square * root) + root


def asin(x: Lanes) -> Lanes:
    """Returns the arcsine."""
    is_great, arc = _asin_parts(abs(x))
    return is_great.where(_quarter_less(arc * 2), arc).call("copysign", x)


def acos(x: Lanes) -> Lanes:
    """Returns the arccosine."""
    is_great, arc = _asin_parts(abs(x))
    far = (x < 0.0).where(math.pi - arc * 2, arc * 2)
    return is_great.where(far, math.pi / 2 - arc.call("copysign", x))
