"""Rules for the primitives that work on each element alone, on lanes and on constants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_all_same, batch_of, count

from mjx_reinforce import fused
from mjx_reinforce.fused import UnsupportedPrimitive, ops
from mjx_reinforce.fused.rules import elementwise

#: Functions of any float; their integers are the eighths of it, and some are shifted and divided.
UNARY = [
    jnp.negative, jnp.abs, jnp.sign, jnp.floor, jnp.ceil, jnp.round, jnp.exp, jnp.exp2, jnp.expm1,
    jnp.sin, jnp.cos, jnp.tan, jnp.arctan, jnp.sinh, jnp.cosh, jnp.tanh, jnp.arcsinh, jnp.cbrt,
    jnp.isfinite, jnp.square, jax.nn.sigmoid, jax.nn.relu, jax.scipy.special.erf,
    lambda x: x / 3, lambda x: x / 4, lambda x: 2 / x, lambda x: x % 0.7,
    lambda x: whole(x) // 3, lambda x: whole(x) % 3, lambda x: whole(x) << 2,
    lambda x: whole(x) >> 1, lambda x: lax.population_count(whole(x)),
    lambda x: lax.bitcast_convert_type(x, jnp.int32), lambda x: lax.nextafter(x, x + 1),
    lambda x: lax.clamp(jnp.float32(-1), x, jnp.float32(0.75)), lambda x: (x > 0) ^ (x > 1),
    lambda x: [lax.integer_pow(x, power) for power in (0, 1, 2, 3, 5, -1, -2)],
    lambda x: [abs(x).astype(kind) for kind in (np.int32, np.uint8, bool, np.float16)],
]  # fmt: skip
#: Functions of numbers above 1, and within it.
POSITIVE = [
    jnp.sqrt, jnp.log, jnp.log1p, lax.rsqrt, jnp.arccosh, lambda x: x**0.5, lambda x: x**1.7,
    lax.lgamma, lax.digamma, lambda x: lax.pow(x, np.arange(4, dtype=np.int32)),
]  # fmt: skip
UNIT = [jnp.arcsin, jnp.arccos, jnp.arctanh, jax.scipy.special.erfinv]
BINARY = [
    jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.maximum, jnp.minimum, jnp.arctan2,
    jnp.less, jnp.greater_equal, jnp.equal, jnp.not_equal, lax.rem, jnp.hypot, jnp.logaddexp,
    lambda x, y: jnp.abs(x) ** y, jnp.cross, jnp.outer,
]  # fmt: skip


def whole(x):
    return (x * 8).astype(jnp.int32)


@pytest.mark.parametrize(
    ("functions", "args"),
    [
        (UNARY, [batch_of(5)]),
        (POSITIVE, [batch_of(4, low=1.1, high=4)]),
        (UNIT, [batch_of(4, low=-0.9, high=0.9)]),
        (BINARY, [batch_of(3), batch_of(3, seed=1)]),
    ],
    ids=["unary", "positive", "unit", "binary"],
)
def test_functions_of_each_element(functions, args):
    assert_all_same(dict(enumerate(functions)), *args, rtol=1e-5)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", [jnp.int8, jnp.uint32])
def test_division_by_a_constant_zero_is_that_by_an_input(dtype):
    """By integers -1, and the dividend remains. XLA itself stops the process at such a constant."""
    x, zero = jnp.array([7, 0, 1], dtype), jnp.zeros(3, dtype)
    for function in (lax.div, lax.rem):
        expected = jax.vmap(function)(x, zero), jax.vmap(function)(zero, x)

        def divided(x, zero, function=function):
            constants = [function(number, dtype(0)) for number in (dtype(7), dtype(1))]
            return function(x, zero), function(x, dtype(0)), function(dtype(0), x), constants

        by_input, by_constant, of_constant, constants = fused.vmap(
            divided, out_axes=(0, 0, 0, None)
        )(x, zero)
        np.testing.assert_array_equal(by_input, expected[0])
        np.testing.assert_array_equal(by_constant, expected[0])
        np.testing.assert_array_equal(of_constant, expected[1])
        np.testing.assert_array_equal(constants, expected[0][jnp.array([0, 2])])


def test_what_costs_nothing_or_little():
    assert count(lambda x: lax.convert_element_type(x, jnp.float32), jnp.ones(3)) == 0
    assert count(lambda x: x**8, jnp.float32(1)) == 3
    assert count(lax.square, jnp.ones(3)) == 3


def test_bits_of_another_size_are_refused():
    with pytest.raises(UnsupportedPrimitive, match="bitcast_convert_type to another size"):
        fused.scalarize(lambda x: lax.bitcast_convert_type(x, jnp.int8), jnp.ones(3))


def test_every_operation_has_the_general_rule_or_one_of_its_own():
    assert ops.FACTS.keys() <= elementwise.RULES.keys()
