"""Rules that combine the elements of an array, on constants: what JAX computes, bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_folds, folded

X = np.array([[3, -1, 2, -1], [0.5, 4, 4, -7]], np.float32)
NAN = np.array([1, np.nan, 3, -np.inf, np.nan, -0.0, 0.0], np.float32)


@pytest.mark.parametrize("axis", [None, 0, 1])
@pytest.mark.parametrize("reduce", [jnp.sum, jnp.prod, jnp.max, jnp.min])
def test_reductions(reduce, axis):
    assert_folds(lambda x: reduce(x, axis=axis), X)
    assert_folds(lambda x: reduce(x, axis=axis), X.astype(np.int32))


@pytest.mark.parametrize("reduce", [jnp.all, jnp.any, lambda x, axis: lax.reduce_xor(x, (axis,))])
def test_reductions_of_bools(reduce):
    assert_folds(lambda x: reduce(x, axis=1), X > 0)


@pytest.mark.parametrize("reduce", [jnp.sum, jnp.prod])
def test_nothing_to_combine(reduce):
    assert_folds(reduce, np.zeros((0,), np.float32))


def test_a_sum_is_from_the_first_to_the_last():
    parts = np.array([1e8, 1, -1e8, 1], np.float32)
    (total,) = folded(jnp.sum, parts)
    assert total == np.float32(np.float32(np.float32(1e8 + 1) - 1e8) + 1) == 1


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("cumulate", [lax.cumsum, lax.cumprod, lax.cummax, lax.cummin])
def test_prefixes(cumulate, reverse):
    for axis in (0, 1):
        assert_folds(lambda x, axis=axis: cumulate(x, axis, reverse), X)


def test_prefixes_of_logarithms():
    assert_folds(lambda x: lax.cumlogsumexp(x), np.array([0, 1, -np.inf, 3], np.float32), rtol=1e-6)
    equal = np.array([-np.inf, -np.inf, 2], np.float32)
    assert_folds(lambda x: lax.cumlogsumexp(x), equal, rtol=1e-6)


@pytest.mark.parametrize("extreme", [jnp.argmax, jnp.argmin])
def test_where_the_extreme_is(extreme):
    """The first of equal ones; the first NaN where there is one."""
    for axis in (0, 1):
        assert_folds(lambda x, axis=axis: extreme(x, axis), X)
    assert_folds(extreme, NAN)
    assert_folds(extreme, np.array([2, 5, 5, 1, 1], np.int32))


def test_order():
    assert_folds(jnp.sort, NAN)
    assert_folds(lambda x: jnp.sort(x, axis=0), X)
    assert_folds(jnp.argsort, np.array([2, 1, 2, 1, 0], np.int32))  # stable


def test_order_by_two_keys_takes_the_rest_along():
    first, second = np.array([1, 0, 1, 0], np.int32), np.array([3, 9, 2, 8], np.int32)
    rest = np.arange(4, dtype=np.float32)
    assert_folds(lambda *x: lax.sort(x, num_keys=2), first, second, rest)
    assert [
        x.tolist() for x in folded(lambda *x: lax.sort(x, num_keys=2), first, second, rest)
    ] == [
        [0, 0, 1, 1],
        [8, 9, 2, 3],
        [3, 1, 2, 0],
    ]


@pytest.mark.parametrize("k", [1, 3])
def test_the_largest(k):
    """Of equal ones the first, -0 below 0, and NaN above all."""
    assert_folds(lambda x: jax.lax.top_k(x, k), X)
    assert_folds(lambda x: jax.lax.top_k(x, k), np.array([-0.0, 0.0, -1, np.nan], np.float32))
    assert_folds(lambda x: jax.lax.top_k(x, k), np.array([5, 7, 7, 2], np.int32))
