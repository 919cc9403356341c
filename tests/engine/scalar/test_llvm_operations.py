"""The instructions of each operation: NumPy's results, also of NaN, infinities and zeros."""

import functools
import math
import platform
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from lane_code import call, engine, parse
from scipy import special

from mjx_reinforce.engine.llvm.lanes import Lanes
from mjx_reinforce.engine.llvm.math import FUNCTIONS, RARE_FUNCTIONS
from mjx_reinforce.engine.llvm.operations import OPERATIONS
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import Op

pytest.importorskip("llvmlite", reason="machine code is written by llvmlite")

LANES = 16
X = np.float32(
    [0, -0.0, 1, -1, 1e-40, -1e-40, np.inf, -np.inf, np.nan, 2.5, -2.5, 0.5, 3e38, 7, -1.5, 1.5]
)
Y = np.float32(
    [-0.0, 0, np.nan, 3, 1e-40, 2, -np.inf, np.inf, 1, -2, 0.75, 0.5, -3e38, 0.1, -0.0, 1.5]
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


# -------------------------------------------------------------------------------------------------
# The transcendental operations as machine code: their errors, their edges, their lanes.

llvm = pytest.importorskip("llvmlite.binding", reason="machine code is written by llvmlite")

INFINITY, NAN = np.inf, np.nan
COUNT = 4096
RNG = np.random.default_rng(0)


def even(low, high):
    return RNG.uniform(low, high, COUNT)


def log_even(low, high):
    return np.exp(RNG.uniform(np.log(low), np.log(high), COUNT))


def join(*parts):
    return np.concatenate(parts)


def erf_inv(x):
    """SciPy's, but for the sign of zero."""
    return np.copysign(special.erfinv(x), x)


TINY = log_even(1e-37, 1)
#: Normal numbers of all sizes and both signs.
ALL = join(log_even(1e-37, 3e38), -log_even(1e-37, 3e38), even(-10, 10), even(-1, 1))
TO_1 = np.clip(join(even(-1, 1), TINY, 1 - log_even(6e-8, 1)), -1 + 2**-24, 1 - 2**-24)
EDGES = (0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 0.5, 100.0, -100.0, 1e30, -1e30, INFINITY, -INFINITY, NAN)
#: Negative numbers have whole powers alone.
BASES, WHOLE = even(-3, 3), RNG.integers(-3, 4, COUNT)
#: name -> (the same in float64, where, greatest error in units of the last place)
CASES = {
    "acos": (np.arccos, [TO_1], 2),
    "acosh": (np.arccosh, [1 + join(log_even(1.2e-7, 10), log_even(1, 3e38))], 3),
    "asin": (np.arcsin, [TO_1], 2),
    "asinh": (np.arcsinh, [ALL], 2),
    "atan": (np.arctan, [ALL], 2),
    "atan2": (np.arctan2, [join(even(-1, 1), log_even(1e-15, 1e15)), even(-1, 1).repeat(2)], 2),
    "atanh": (np.arctanh, [TO_1], 2.5),
    "cbrt": (np.cbrt, [ALL], 1),
    "cos": (np.cos, [even(-10, 10)], 2),
    "cosh": (np.cosh, [join(even(-89.4, 89.4), even(-3, 3))], 2),
    "erf": (special.erf, [join(even(-5, 5), TINY)], 2),
    "erf_inv": (erf_inv, [even(-0.999, 0.999)], 6),
    "erfc": (np.vectorize(math.erfc, otypes=[float]), [join(even(-5, 9), TINY)], 7),
    "exp": (np.exp, [join(even(-87.3, 88.7), even(-1, 1))], 1.1),
    "exp2": (np.exp2, [join(even(-126, 128), even(-1, 1))], 1),
    "expm1": (np.expm1, [join(even(-90, 88.7), TINY, -TINY)], 1.5),
    "log": (np.log, [join(log_even(1.2e-38, 3e38), even(0.5, 2))], 1),
    "log1p": (np.log1p, [join(log_even(1e-37, 3e38), even(-1, 1), log_even(6e-8, 1) - 1)], 1.5),
    "logistic": (special.expit, [join(even(-87, 20), TINY)], 2.5),
    "pow": (np.power, [join(log_even(1e-3, 1e3), BASES), join(even(-12, 12), WHOLE)], 0.501),
    "sin": (np.sin, [join(even(-10, 10), TINY)], 2),
    "sinh": (np.sinh, [join(even(-89.4, 89.4), even(-3, 3), TINY)], 2.5),
    "tan": (np.tan, [join(even(-10, 10), TINY)], 3.5),
    "tanh": (np.tanh, [ALL], 3),
}


def write(name, text, dtype, *names):
    lanes = [Lanes(text, np.dtype(dtype), each) for each in names]
    return OPERATIONS[name](Op(name), np.dtype(dtype), *lanes).name


@functools.cache
def compiled(name, dtype, lanes, cpu, num_operands):
    body = lambda text, names: write(name, text, dtype, *names)  # noqa: E731
    return engine(body, [dtype] * num_operands, dtype, lanes, cpu)


def computed(name, *operands, dtype="float32", lanes=16, cpu=None):
    """The function at every entry of the operands, which are padded to whole vectors."""
    dtype = np.dtype(dtype)
    padded = [
        np.pad(np.asarray(x, dtype), (0, -len(x) % lanes), constant_values=0.5) for x in operands
    ]
    function = compiled(name, dtype, lanes, cpu, len(operands))
    return call(function, padded, np.empty_like(padded[0]))[: len(operands[0])]


def ulps(got, want):
    """The distance to float64 values, in units of their last place in float32."""
    unit = np.spacing(np.maximum(np.abs(want.astype(np.float32)), np.float32(2**-126)))
    return np.abs(got.astype(np.float64) - want) / unit


def samples(name):
    exact, operands, bound = CASES[name]
    operands = [x.astype(np.float32) for x in operands]
    with np.errstate(divide="ignore"):
        want = exact(*(x.astype(np.float64) for x in operands))
    normal = (np.abs(want) >= 2**-126) & (np.abs(want) <= np.finfo(np.float32).max)
    assert normal.mean() > 0.8
    return [x[normal] for x in operands], want[normal], bound


def test_every_function_has_a_case():
    assert set(CASES) == set(FUNCTIONS["float32"]) == set(FUNCTIONS["float64"])


@pytest.mark.parametrize("name", CASES)
def test_is_right_to_units_of_the_last_place(name):
    operands, want, bound = samples(name)
    got = computed(name, *operands)
    assert ulps(got, want).max() <= bound
    for lanes in (8, 1):
        np.testing.assert_array_equal(computed(name, *operands, lanes=lanes), got)


@pytest.mark.parametrize("name", CASES)
def test_edges_are_those_of_numpy(name):
    """Zeros with their signs, the ends of the domain and beyond, infinities, any NaN."""
    exact = CASES[name][0]
    other_nan = np.array([0x7FC00001, 0xFFFFFFFF], np.uint32).view(np.float32)
    edges = np.append(np.array(EDGES, np.float32), other_nan)
    operands = [edges]
    if len(CASES[name][1]) == 2:
        operands = [x.ravel() for x in np.meshgrid(edges, edges)]
    with np.errstate(all="ignore"):
        want = exact(*(x.astype(np.float64) for x in operands)).astype(np.float32)
    want = np.where(np.abs(want) < 2**-126, np.copysign(np.float32(0), want), want)  # flushed
    large = (np.abs(operands[0]) > 1e5) & (name in ("sin", "cos", "tan"))
    got = computed(name, *operands)
    np.testing.assert_allclose(got, want, rtol=np.where(large, 1e-5, 1e-6).max())
    numbers = ~np.isnan(want)
    np.testing.assert_array_equal(np.signbit(got[numbers]), np.signbit(want[numbers]))


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_large_angles(name):
    x = join(even(-1e5, 1e5), log_even(1e5, 3e38), -log_even(1e5, 3e38)).astype(np.float32)
    want = CASES[name][0](x.astype(np.float64))
    np.testing.assert_allclose(computed(name, x), want, rtol=0, atol=2e-7)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="asks for an older x86")
@pytest.mark.parametrize("cpu", ["haswell", "x86-64"])  # AVX2; no fused operations
@pytest.mark.parametrize("name", ["sin", "exp", "log1p", "tanh", "erf_inv", "pow", "acos"])
def test_older_processors(name, cpu):
    operands, want, bound = samples(name)
    got = computed(name, *operands, lanes=8, cpu=cpu)
    error = np.abs(got - want) / np.finfo(np.float32).eps if name == "sin" else ulps(got, want)
    assert error.max() <= bound + 1


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="asks for an older x86")
def test_angles_to_1e5_without_fused_operations():
    x = even(-1e5, 1e5).astype(np.float32)
    got = computed("sin", x, lanes=8, cpu="x86-64")
    np.testing.assert_allclose(got, np.sin(x.astype(np.float64)), rtol=0, atol=1.5e-6)


def test_erf_inv_is_that_of_jax():
    """So that `jax.random.normal` is the same in machine code, but for roundings."""
    x = jax.random.uniform(jax.random.key(0), (1 << 16,), minval=-1 + 2**-24)
    x = jnp.append(x, jnp.array([0, 1 - 2**-24, -1 + 2**-24, 0.9966, -0.9966], jnp.float32))
    want = np.asarray(lax.erf_inv(x))
    assert ulps(computed("erf_inv", np.asarray(x)), want.astype(np.float64)).max() <= 2


@pytest.mark.parametrize("name", CASES)
def test_float64(name):
    """To 1e-15 of NumPy's and SciPy's, twice that where the coefficients are not ours."""
    exact, operands, _ = CASES[name]
    with np.errstate(all="ignore"):
        want = exact(*operands)
    keep = np.isfinite(want)
    operands, want = [x[keep] for x in operands], want[keep]
    for lanes in (8, 1):
        got = computed(name, *operands, dtype="float64", lanes=lanes)
        rtol = 2e-15 if name == "erf_inv" else 1e-15
        np.testing.assert_allclose(got, want, rtol=rtol, atol=0)
    edges = [np.array(EDGES)] * len(operands)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(
            computed(name, *edges, dtype="float64"), exact(*edges), rtol=1e-15
        )


@pytest.mark.parametrize(
    ("triple", "cpu", "lanes", "call"),
    [
        ("x86_64-unknown-linux-gnu", "sapphirerapids", 16, r"\bcall"),
        ("x86_64-unknown-linux-gnu", "haswell", 8, r"\bcall"),
        ("aarch64-unknown-linux-gnu", "neoverse-n1", 4, r"\bblr?\b"),
    ],
)
def test_float32_calls_no_library(triple, cpu, lanes, call):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=2)
    for name, (_, operands, _) in CASES.items():
        if name in RARE_FUNCTIONS:
            continue
        text = Text(lanes)
        kind = text.type("float32")
        values = [text.let(f"load {kind}, ptr %in{i}") for i in range(len(operands))]
        text.line(f"store {kind} {write(name, text, np.float32, *values)}, ptr %out")
        text.line("ret void")
        assert not re.search(call, target.emit_assembly(parse(text, len(operands)))), name


def lines(*names):
    """How many lines a function of one value takes that does all these."""
    text = Text(16)
    for name in names:
        write(name, text, np.float32, "%x")
    return len(text.function("void @f()").splitlines())


def test_sine_and_cosine_share_their_reduction():
    assert lines("sin", "cos") < lines("sin") + 12 < lines("sin", "sin") + 12
    assert lines("sin", "cos") < 0.7 * (lines("sin") + lines("cos"))


def test_nothing_is_shared_out_of_a_branch():
    """What is computed in a branch is not there after it; LLVM checks that."""
    text = Text(8)
    x = text.let(f"load {text.type('float32')}, ptr %in0")
    mask = text.let(f"fcmp ogt {text.type('float32')} {x}, {text.constant(np.float32(0))}")
    with text.when(text.any(mask)):
        write("sin", text, np.float32, x)
    result = write("cos", text, np.float32, x)
    text.line(f"store {text.type('float32')} {result}, ptr %out")
    text.line("ret void")
    parse(text, 1)
