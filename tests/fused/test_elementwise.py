"""Rules for the primitives that work on each element alone, on constants and on one lane."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_folds, count

from mjx_reinforce import fused
from mjx_reinforce.fused import UnsupportedPrimitive, ops
from mjx_reinforce.fused.rules import elementwise

X = np.array([-2.5, -1, -0.0, 0.5, 3], np.float32)


@pytest.mark.parametrize("to", [np.int32, np.uint8, bool, np.float16])
def test_conversions(to):
    assert_folds(lambda x: lax.convert_element_type(x, to), np.abs(X))


def test_a_conversion_to_the_same_dtype_is_none():
    assert count(lambda x: lax.convert_element_type(x, jnp.float32), jnp.ones(3)) == 0


def test_bits_are_read_as_another_dtype_of_the_same_size():
    assert_folds(lambda x: lax.bitcast_convert_type(x, jnp.int32), X)
    with pytest.raises(UnsupportedPrimitive, match="bitcast_convert_type to another size"):
        fused.scalarize(lambda x: lax.bitcast_convert_type(x, jnp.int8), jnp.ones(3))


def test_clamped_between_two_bounds():
    assert_folds(lambda x: lax.clamp(jnp.float32(-1), x, jnp.float32(0.75)), X)


@pytest.mark.parametrize("exponent", [0, 1, 2, 3, 5, -1, -2])
def test_whole_powers(exponent):
    assert_folds(lambda x: lax.integer_pow(x, exponent), X + 0.25, rtol=1e-6)


def test_a_whole_power_is_few_products():
    assert count(lambda x: x**8, jnp.float32(1)) == 3


def test_an_integer_exponent_is_one_of_the_base_s_dtype():
    assert_folds(lambda x, n: lax.pow(x, n), np.abs(X), np.arange(5, dtype=np.int32), rtol=1e-6)


def test_squares_and_sums_of_any_kind():
    assert_folds(lambda x: lax.square(x), X)
    assert count(lambda x: lax.square(x), jnp.ones(3)) == 3


def test_every_operation_has_the_general_rule_or_one_of_its_own():
    assert ops.FACTS.keys() <= elementwise.RULES.keys()
