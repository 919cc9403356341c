"""Lane vectors under Python's operators: NumPy's results of the same formulas."""

import ctypes

import numpy as np
import pytest

from mjx_reinforce.fused.backends.llvm_lanes import ROUND, Lanes
from mjx_reinforce.fused.backends.llvm_text import Text

llvm = pytest.importorskip("llvmlite.binding", reason="machine code is written by llvmlite")

LANES = 8
X = np.float32([1.5, -2.25, 0.0, -0.0, np.nan, np.inf, 3e7, -7.0])
Y = np.float32([2.0, -2.25, 1.0, np.nan, 1.0, 2.0, -3.0, 0.5])
I = np.int32([1, -1, 5, -7, 2**31 - 1, 0, 12, -(2**31)])  # noqa: E741
J = np.int32([1, 2, 3, 4, 5, 6, 7, 8])


def run(formula, *operands):
    """What the machine code of a formula makes of lane vectors; masks become 0 and 1."""
    text = Text(LANES)
    loaded = [
        Lanes(text, x.dtype, text.let(f"load {text.type(x.dtype)}, ptr %in{i}, align 1"))
        for i, x in enumerate(operands)
    ]
    result = formula(*loaded)
    if result.dtype == np.bool_:
        result = result.convert("zext", np.int8)
    text.line(f"store {text.type(result.dtype)} {result.name}, ptr %out, align 1")
    text.line("ret void")
    arguments = ", ".join(f"ptr %in{i}" for i in range(len(operands)))
    module = llvm.parse_assembly(text.function(f"void @f({arguments}, ptr %out)"))
    module.verify()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(opt=0, jit=True)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    out = np.zeros(LANES, result.dtype)
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * (1 + len(operands)))
    kind(engine.get_function_address("f"))(*(x.ctypes.data for x in (*operands, out)))
    return out


def check(formula, *operands):
    with np.errstate(all="ignore"):
        want = formula(*operands)
    got = run(formula, *operands)
    np.testing.assert_array_equal(got, want)
    assert got.dtype == (np.int8 if want.dtype == bool else want.dtype)


@pytest.mark.parametrize(
    "formula",
    [
        lambda x, y: x + y,
        lambda x, y: x - y,
        lambda x, y: x * y,
        lambda x, y: x / y,
        lambda x, y: 2 + x,
        lambda x, y: 2 - x,
        lambda x, y: 2 * x,
        lambda x, y: 2 / x,
        lambda x, y: x / 4,
        lambda x, y: abs(-x),
    ],
)
def test_arithmetic(formula):
    check(formula, X, Y)


def test_a_negative_is_that_of_zero_too():
    assert np.signbit(run(lambda x: -x, np.zeros(LANES, np.float32))).all()


@pytest.mark.parametrize(
    "formula",
    [
        lambda x, y: x + y,
        lambda x, y: 3 - x,
        lambda x, y: x * y,
        lambda x, y: x & y,
        lambda x, y: x | y,
        lambda x, y: x ^ 6,
        lambda x, y: x << y,
        lambda x, y: x >> y,
    ],
)
def test_integers(formula):
    check(formula, I, J)


@pytest.mark.parametrize(
    ("formula", "name"),
    [
        (lambda x, y: x < y, "lt"),
        (lambda x, y: x <= y, "le"),
        (lambda x, y: x > y, "gt"),
        (lambda x, y: x >= y, "ge"),
        (np.equal, "eq"),
        (np.not_equal, "ne"),
    ],
)
@pytest.mark.parametrize("operands", [(X, Y), (Y, X), (I, J), (J, I)], ids=["f", "fr", "i", "ir"])
def test_comparisons(formula, name, operands):
    """With NaN all are false, except that it is unequal; integers have a sign."""
    got = run(lambda x, y: x.compare(name, y), *operands)
    np.testing.assert_array_equal(got, formula(*operands))
    if name not in ("eq", "ne"):
        np.testing.assert_array_equal(run(formula, *operands), got)


def test_where_takes_either_side_and_numbers():
    got = run(lambda x, y: (x < y).where(x, y), X, Y)
    np.testing.assert_array_equal(got, np.where(X < Y, X, Y))
    np.testing.assert_array_equal(
        run(lambda x, y: (x < y).where(9.0, x), X, Y), np.where(X < Y, np.float32(9), X)
    )
    np.testing.assert_array_equal(
        run(lambda x, y: (x < y).where(x, 9.0), X, Y), np.where(X < Y, X, np.float32(9))
    )


def test_masks_combine():
    both = run(lambda x, y: (x < 2) & (y > 0) | (x > 5), I, J)
    np.testing.assert_array_equal(both, (I < 2) & (J > 0) | (I > 5))


def test_bits_are_those_of_the_same_width():
    np.testing.assert_array_equal(run(lambda x: x.bits(), X), X.view(np.int32))
    wide = X.astype(np.float64)
    np.testing.assert_array_equal(run(lambda x: x.bits(), wide), wide.view(np.int64))
    back = run(lambda x: x.bits().bits(), X)
    np.testing.assert_array_equal(back.view(np.int32), X.view(np.int32))


def test_conversions_and_intrinsics():
    np.testing.assert_array_equal(run(lambda i: i.convert("sitofp", np.float32), I), np.float32(I))
    got = run(lambda x, y: x.call("copysign", y), X, Y)
    np.testing.assert_array_equal(np.signbit(got), np.signbit(Y))
    np.testing.assert_array_equal(
        run(lambda x: x.call("maxnum", 1.0), Y), np.fmax(Y, np.float32(1))
    )


def test_a_polynomial_has_its_highest_power_first():
    x = np.float32([0, 1, -1, 2, -2, 3, 0.5, 4])
    np.testing.assert_array_equal(
        run(lambda x: x.polynomial(2.0, -3.0, 5.0), x), 2 * x**2 - 3 * x + 5
    )


def test_round_is_the_nearest_integer():
    """And its lowest bits are those of that integer."""
    x = np.float32([0.4, 0.6, -0.6, 1.5, 2.5, -1e6 - 0.25, 4e6, -3.49])
    np.testing.assert_array_equal(run(lambda x: x + ROUND - ROUND, x), np.rint(x))
    low = run(lambda x: (x + ROUND).bits() & 0xFF, x)
    np.testing.assert_array_equal(low, np.rint(x).astype(np.int32) & 0xFF)
