"""Arcs of float32 lanes."""

import math

from mjx_reinforce.fused.backends.llvm_lanes import Lanes

#: pi / 2 less its float32.
_HALF_PI_LOW = -4.371139000186241e-08


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
