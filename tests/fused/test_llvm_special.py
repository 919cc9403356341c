"""Error functions, powers and cube roots of lanes: what holds between their results."""

import ctypes

import numpy as np
import pytest

from mjx_reinforce.fused.backends import llvm_special
from mjx_reinforce.fused.backends.llvm_lanes import Lanes
from mjx_reinforce.fused.backends.llvm_text import Text

llvm = pytest.importorskip("llvmlite.binding", reason="machine code is written by llvmlite")

LANES = 16
X = np.random.default_rng(0).uniform(-3, 3, LANES).astype(np.float32)


def compute(function, *operands):
    """The function of lanes [16], as machine code for this CPU."""
    text, kind = Text(LANES), np.dtype(np.float32)
    names = [text.let(f"load {text.type(kind)}, ptr %in{i}, align 4") for i in range(len(operands))]
    result = function(*(Lanes(text, kind, name) for name in names)).name
    text.line(f"store {text.type(kind)} {result}, ptr %out, align 4")
    text.line("ret void")
    pointers = ", ".join(f"ptr %in{i}" for i in range(len(operands)))
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(text.function(f"void @f({pointers}, ptr %out)"))
    target = llvm.Target.from_default_triple().create_target_machine(opt=0, jit=True)
    compiled = llvm.create_mcjit_compiler(module, target)
    compiled.finalize_object()
    given, out = [np.broadcast_to(x, LANES).astype(kind) for x in operands], np.empty(LANES, kind)
    function_type = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * (len(given) + 1))
    address = compiled.get_function_address("f")
    function_type(address)(*(x.ctypes.data for x in (*given, out)))
    return out


def test_the_error_function_is_odd_and_rises():
    erf = compute(llvm_special.erf, X)
    np.testing.assert_array_equal(compute(llvm_special.erf, -X), -erf)
    assert np.all(np.diff(erf[np.argsort(X)]) > 0)


def test_the_inverse_undoes_the_error_function():
    back = compute(llvm_special.erf_inv, compute(llvm_special.erf, X / 2))
    np.testing.assert_allclose(back, X / 2, rtol=1e-5)
    ends = compute(llvm_special.erf_inv, np.array([1, -1, 0, 2] * 4))
    np.testing.assert_array_equal(ends, [np.inf, -np.inf, 0, np.nan] * 4)


@pytest.mark.parametrize("power", [-3, -2, -1, 0, 1, 2, 3])
def test_whole_powers_are_products(power):
    want = X.astype(np.float64) ** power
    np.testing.assert_allclose(compute(llvm_special.pow, X, power), want, rtol=1e-7)


def test_powers_that_no_number_is():
    assert np.all(np.isnan(compute(llvm_special.pow, -abs(X), 0.5)))
    np.testing.assert_array_equal(compute(llvm_special.pow, 0.0, -1.0), np.inf)
    np.testing.assert_array_equal(compute(llvm_special.pow, np.nan, 0.0), 1)
