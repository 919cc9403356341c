"""The instructions of each operation: NumPy's results, also of NaN, infinities and zeros."""

import numpy as np
import pytest
from jax import lax
from lane_code import call, engine

from mjx_reinforce.engine.llvm.lanes import Lanes
from mjx_reinforce.engine.llvm.operations import OPERATIONS
from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import Op

pytest.importorskip("llvmlite", reason="machine code is written by llvmlite")

LANES = 16
INFINITY = np.inf
X = np.float32(
    [0, -0.0, 1, -1, 1e-40, -1e-40, INFINITY, -INFINITY, np.nan, 2.5, -2.5, 0.5, 3e38, 7, -1.5, 1.5]
)
Y = np.float32(
    [-0.0, 0, np.nan, 3, 1e-40, 2, -INFINITY, INFINITY, 1, -2, 0.75, 0.5, -3e38, 0.1, -0.0, 1.5]
)
I = np.int32([0, 1, -1, 2**31 - 1, -(2**31), 5, -5, 7, -7, 8, 100, -100, 31, 32, 3, -3])  # noqa: E741
J = np.int32([1, 1, -1, 1, 1, 3, 3, -2, -2, 40, 31, 32, 0, 33, 31, 2])
U, V = I.view(np.uint32), J.view(np.uint32)
B = I % 2 == 0


def run(name, *operands, dtype=None, **params):
    """What the instructions make of vectors."""
    kinds = [x.dtype for x in operands]
    dtype = np.dtype(dtype or kinds[-1])
    op = Op(name, tuple(sorted(params.items())))

    def write(text, names):
        lanes = [Lanes(text, kind, each) for kind, each in zip(kinds, names, strict=True)]
        return OPERATIONS[name](op, dtype, *lanes).name

    return call(engine(write, kinds, dtype, LANES), operands, np.zeros(LANES, dtype))


def assert_bits(got, want, told=""):
    """Equal numbers, equal signs of zeros, and NaN where NaN is."""
    np.testing.assert_array_equal(got, want, err_msg=told)
    if got.dtype.kind == "f":
        number = ~np.isnan(want)
        np.testing.assert_array_equal(np.signbit(got)[number], np.signbit(want)[number], told)


def shifted(x, y, how):
    """By more bits than there are, nothing is left but copies of the sign."""
    by, bits = y.view(np.uint32).astype(np.int64), x.view(np.uint32).astype(np.int64)
    inside = by < 32
    by = np.minimum(by, 31)
    if how == "right_arithmetic":
        return (x.astype(np.int64) >> by).astype(np.int32)
    moved = bits << by if how == "left" else bits >> by
    return np.where(inside, moved & 0xFFFFFFFF, 0).astype(np.uint32).view(x.dtype)


def nearest_away(x):
    return np.copysign(np.floor(np.abs(x) + np.float32(0.5)), x)


FLOATS = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "rem": np.fmod,
    "neg": np.negative, "abs": np.abs, "floor": np.floor, "ceil": np.ceil, "sqrt": np.sqrt,
    "sign": lambda x: np.where(x == 0, x, np.sign(x)),  # XLA's keeps the sign of a zero
    "rsqrt": lambda x: np.float32(1) / np.sqrt(x),
}  # fmt: skip
INTEGERS = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "and": np.bitwise_and,
    "or": np.bitwise_or, "xor": np.bitwise_xor, "max": np.maximum, "min": np.minimum,
    "neg": np.negative, "abs": np.abs, "not": np.invert, "sign": np.sign,
    "population_count": lambda x: [bin(n).count("1") for n in x.view(np.uint32).tolist()],
    "clz": lambda x: [32 - n.bit_length() for n in x.view(np.uint32).tolist()],
}  # fmt: skip
COMPARISONS = {
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal,
}  # fmt: skip


def operands_of(function, *operands):
    return operands[: function.nin if isinstance(function, np.ufunc) else 1]


def test_floats():
    for name, function in FLOATS.items():
        operands = operands_of(function, X, Y)
        with np.errstate(all="ignore"):
            want = function(*operands)
        assert_bits(run(name, *operands), want, name)


def test_extremes_are_nan_where_either_is():
    for name, function in {"max": np.maximum, "min": np.minimum}.items():
        np.testing.assert_array_equal(run(name, X, Y), function(X, Y))
        np.testing.assert_array_equal(run(name, Y, X), function(X, Y))


@pytest.mark.parametrize("kind", [np.int32, np.uint32])
def test_integers(kind):
    """Also the least, which has no negative of its own; unsigned ones are never negative."""
    for name, function in INTEGERS.items():
        if (name, kind) == ("abs", np.uint32):
            continue  # JAX has none
        operands = operands_of(function, I.view(kind), J.view(kind))
        with np.errstate(all="ignore"):
            want = np.asarray(function(*operands), kind)
        assert_bits(run(name, *operands), want, name)


def test_comparisons():
    """With NaN all are false, except that it is unequal."""
    for name, function in COMPARISONS.items():
        for operands in ((X, Y), (I, J), (U, V), (X, X)):
            want = function(*operands)
            assert_bits(run(name, *operands, dtype=bool), want, name)
            assert want.any() or operands[0] is operands[1]


def test_integers_are_divided_towards_zero():
    """By zero, and where the quotient is no int32, XLA's results are in another test."""
    divides = (J != 0) & ~((I == -(2**31)) & (J == -1))
    quotient = np.trunc(I.astype(np.float64) / np.where(J == 0, 1, J)).astype(np.int64)
    for name, want in {"div": quotient, "rem": I - quotient * J}.items():
        np.testing.assert_array_equal(run(name, I, J)[divides], want[divides])


def test_shifts():
    for name in ("left", "right_logical", "right_arithmetic"):
        assert_bits(run(f"shift_{name}", I, J), shifted(I, J, name), name)


def test_rounding_has_two_ways():
    away, even = lax.RoundingMethod.AWAY_FROM_ZERO, lax.RoundingMethod.TO_NEAREST_EVEN
    assert_bits(run("round", X, rounding_method=even), np.rint(X))
    assert_bits(run("round", X, rounding_method=away), nearest_away(X))
    assert np.any(np.rint(X) != nearest_away(X))


def test_finite():
    assert_bits(run("is_finite", X, dtype=bool), np.isfinite(X))
    assert run("is_finite", I, dtype=bool).all()


def test_a_case_is_selected():
    assert_bits(run("select_n", B, X, Y), np.where(B, Y, X))
    which = np.abs(J) % 3
    assert_bits(run("select_n", which, I, J, I + J), np.choose(which, [I, J, I + J]))


def test_bools():
    both = I % 3 == 0
    for name, function in {"and": B & both, "or": B | both, "xor": B ^ both}.items():
        assert_bits(run(name, B, both), function)
    assert_bits(run("not", B), ~B)
    assert_bits(run("max", B, both), B | both)
    assert_bits(run("min", B, both), B & both)


def converted(x, after):
    return run("convert_element_type", x, dtype=after, new_dtype=np.dtype(after))


def test_a_float_out_of_range_becomes_the_nearest_integer():
    exact = np.nan_to_num(np.trunc(X.astype(np.float64)), nan=0.0)
    for after in (np.int32, np.uint32, np.int8):
        limits = np.iinfo(after)
        assert_bits(converted(X, after), np.clip(exact, limits.min, limits.max).astype(after))


def test_conversions():
    for x, *kinds in (
        (I, np.float32, np.bool_, np.int8),
        (U, np.float32, np.float64),
        (B, np.float32, np.int32),
        (X, np.bool_, np.float64),
    ):
        for after in kinds:
            assert_bits(converted(x, after), x.astype(after), f"{x.dtype} to {after}")


def test_bits_stay():
    assert_bits(run("bitcast_convert_type", X, dtype=np.int32), X.view(np.int32))
    got = run("bitcast_convert_type", X.view(np.int32), dtype=np.float32)
    np.testing.assert_array_equal(got.view(np.int32), X.view(np.int32))


def test_what_has_no_instruction_is_refused():
    with pytest.raises(UnsupportedPrimitive, match="no instruction for 'nextafter'"):
        OPERATIONS["nextafter"](Op("nextafter"), np.dtype("f4"))
