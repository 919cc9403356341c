"""What the rules make of JAX's primitives, against ``jax.vmap``, primitive by primitive."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import (
    BATCH,
    assert_same,
    batch_of,
    count,
)

from mjx_reinforce import fused

UNARY = [
    jnp.negative, jnp.abs, jnp.sign, jnp.floor, jnp.ceil, jnp.round, jnp.exp, jnp.exp2, jnp.expm1,
    jnp.sin, jnp.cos, jnp.tan, jnp.arctan, jnp.sinh, jnp.cosh, jnp.tanh, jnp.arcsinh, jnp.cbrt,
    jnp.isfinite, jnp.square, jax.nn.sigmoid, jax.nn.relu, jax.scipy.special.erf,
    lambda x: x**2, lambda x: x**3, lambda x: x**-2, lambda x: x / 3, lambda x: x / 4,
    lambda x: 2 / x, lambda x: x % 0.7, lambda x: jnp.clip(x, -1, 1), lambda x: x > 0.5,
    lambda x: x.astype(jnp.int32) // 2, lambda x: x.astype(jnp.int32) % 3,
    lambda x: (x > 0) * x, lambda x: (x > 0) * 2.0 - 1.0, lambda x: ~(x > 0) | (x < -1),
    lambda x: jnp.where(x > 0, x, 0.0), lambda x: (x > 0) ^ (x > 1),
    lambda x: (x * 8).astype(jnp.int32) << 2, lambda x: (x * 8).astype(jnp.int32) >> 1,
    lambda x: lax.population_count((x * 8).astype(jnp.int32)), lambda x: lax.nextafter(x, x + 1),
    lambda x: lax.select_n(x > 0, x, -x), lambda x: lax.clamp(-1.0, x, 0.5),
]  # fmt: skip


POSITIVE = [
    jnp.sqrt, jnp.log, jnp.log1p, lax.rsqrt, jnp.arccosh, lambda x: x**0.5, lambda x: x**1.7,
    lax.lgamma, lax.digamma,
]  # fmt: skip


UNIT = [jnp.arcsin, jnp.arccos, jnp.arctanh, jax.scipy.special.erfinv]


@pytest.mark.parametrize("fn", UNARY)
def test_elementwise(fn):
    assert_same(fn, batch_of(5), rtol=1e-5)


@pytest.mark.parametrize("fn", POSITIVE)
def test_elementwise_on_positive_numbers(fn):
    assert_same(fn, batch_of(4, low=1.1, high=4), rtol=1e-5)


@pytest.mark.parametrize("fn", UNIT)
def test_elementwise_on_the_unit_interval(fn):
    assert_same(fn, batch_of(4, low=-0.9, high=0.9), rtol=1e-5)


BINARY = [
    jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.maximum, jnp.minimum, jnp.arctan2,
    lambda x, y: x < y, lambda x, y: x >= y, lambda x, y: x == y, lambda x, y: x != y,
    lambda x, y: lax.rem(x, y), lambda x, y: jnp.abs(x) ** y, jnp.hypot, jnp.logaddexp,
    lambda x, y: x + -y, lambda x, y: -x * -y, lambda x, y: -(x - y), lambda x, y: x[0] * y,
    lambda x, y: x @ y, lambda x, y: jnp.outer(x, y), jnp.cross,
    lambda x, y: jnp.einsum("i,j->", x, y),
]  # fmt: skip


@pytest.mark.parametrize("fn", BINARY)
def test_two_operands(fn):
    assert_same(fn, batch_of(3), batch_of(3, seed=1), rtol=1e-5)


ARRAY = [
    lambda x: x.T, lambda x: x[1:, ::2], lambda x: x[::-1], lambda x: x.reshape(6, 2),
    lambda x: jnp.broadcast_to(x, (2, 3, 4)), lambda x: jnp.pad(x, ((1, 0), (0, 2))),
    lambda x: lax.pad(x, 7.0, ((-1, 1, 0), (2, -1, 1))), lambda x: jnp.tile(x, (2, 1)),
    lambda x: jnp.concatenate([x, jnp.ones((1, 4)), 2 * x]), lambda x: jnp.stack([x, x * 0], 1),
    lambda x: jnp.split(x, 2, axis=1), lambda x: list(x), lambda x: jnp.repeat(x, 2, axis=0),
    lambda x: x + jnp.arange(4), lambda x: lax.expand_dims(x, (1,)),
    lambda x: x.sum(), lambda x: x.sum(0), lambda x: x.prod(1), lambda x: x.max(1),
    lambda x: x.min(),
    lambda x: x.mean(), lambda x: (x > 0).all(1), lambda x: (x > 1).any(),
    lambda x: x[:, :0].sum(),
    lambda x: jnp.cumsum(x, 0), lambda x: jnp.cumprod(x, 1),
    lambda x: lax.cummax(x, 1, reverse=True),
    lambda x: lax.cumlogsumexp(x, 0), lambda x: x.argmax(1), lambda x: x.argmin(),
    lambda x: jnp.sort(x, 1), lambda x: jnp.argsort(x.ravel()), lambda x: jnp.sort(x, 0)[::-1],
    lambda x: jnp.linalg.norm(x), lambda x: x @ x.T, lambda x: x[:, jnp.array([3, 0])],
    lambda x: x.at[1].set(0.5), lambda x: x.at[:, 2].add(x[:, 0]), lambda x: x.at[0, 1].mul(3),
    lambda x: x.at[jnp.array([0, 0, 2])].add(1.0), lambda x: x.at[7].set(1.0),
    lambda x: x.at[5].get(),
    lambda x: x.at[jnp.array([1, 9])].get(mode="fill", fill_value=-1.0),
    lambda x: x.at[1].min(0.2),
    lambda x: x.at[1:3, 1].max(0.2), lambda x: lax.dynamic_slice(x, (1, 3), (2, 2)),
    lambda x: lax.dynamic_update_slice(x, x[:1, :2], (2, 3)), lambda x: jnp.triu(x[:, :3]),
    lambda x: jnp.linalg.cholesky(x @ x.T + jnp.eye(3)),
    lambda x: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(x @ x.T + jnp.eye(3)), x),
    lambda x: jax.scipy.linalg.solve_triangular(jnp.eye(3) * 2 + jnp.tril(x @ x.T), x, lower=True),
    lambda x: jax.scipy.linalg.solve_triangular(jnp.eye(3) * 3 + jnp.triu(x @ x.T, 1), x, trans=1),
    lambda x: lax.linalg.triangular_solve(x[:, :3].T @ x[:, :3] + jnp.eye(3), x.T, lower=True),
    lambda x: jax.vmap(jnp.dot)(x, x), lambda x: {"a": x, "b": (x[0], None, jnp.ones(2))},
    lambda x: jnp.nonzero(jnp.array([0, 1, 1]), size=2)[0] + x[0, 0],
    lambda x: x.at[jnp.zeros(0, int)].set(1.0), lambda x: x.at[jnp.zeros(0, int), 1].add(1.0),
    lambda x: lax.top_k(x, 3), lambda x: lax.top_k(jnp.round(x), 2),
    lambda x: lax.top_k(jnp.round(x.ravel()).astype(jnp.int32), 12), lambda x: lax.top_k(x, 0),
]  # fmt: skip


def test_the_largest_are_ordered_as_xla_orders_them():
    """By their bits: 0 above -0, NaN above infinity; the first of equal ones is the first."""
    x = jnp.array([jnp.nan, 1, jnp.inf, -jnp.inf, -jnp.nan, -0.0, 0.0, -0.0, 0.0, 1, 2, 2])
    x = jnp.stack([jnp.roll(x, shift) for shift in range(BATCH)])
    got = jax.jit(fused.vmap(lambda row: lax.top_k(row, 11)))(x)
    for ours, theirs in zip(got, lax.top_k(x, 11), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("fn", ARRAY)
def test_arrays(fn):
    assert_same(fn, batch_of(3, 4), rtol=1e-4, atol=1e-5)


DYNAMIC = [
    lambda x, i: x[i], lambda x, i: x[:, i], lambda x, i: x[i, i + 1], lambda x, i: x[i, :2],
    lambda x, i: x.at[i].set(9.0), lambda x, i: x.at[:, i].add(x[:, 0]),
    lambda x, i: x.at[i].get(mode="fill"), lambda x, i: x.at[i].get(mode="clip"),
    lambda x, i: lax.dynamic_slice(x, (i, i), (2, 2)),
    lambda x, i: lax.dynamic_update_slice(x, x[:1, :2], (i, i)),
]  # fmt: skip


@pytest.mark.parametrize("fn", DYNAMIC)
def test_indices_that_depend_on_the_lane(fn):
    assert_same(fn, batch_of(3, 4), jnp.array([-5, -1, 0, 1, 2, 7]))


def test_a_factor_is_nan_from_the_column_on_that_shows_it_is_none():
    factor = fused.vmap(lax.linalg.cholesky)(jnp.array([[[1.0, 2.0], [2.0, 1.0]]]))
    np.testing.assert_array_equal(factor, [[[1, 0], [2, np.nan]]])


def test_infinite_terms_of_a_sum_of_exponentials():
    x = jnp.array([[-jnp.inf, -jnp.inf, 1.0], [jnp.inf, jnp.inf, 1], [jnp.inf, -jnp.inf, 1]])
    x = jnp.concatenate([x, jnp.array([[jnp.nan, 1.0, 2.0], [1.0, 2.0, 3.0]])])
    assert_same(lambda x: lax.cumlogsumexp(x, 0), x)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("function", [lax.div, lax.rem])
@pytest.mark.parametrize("dtype", [jnp.int8, jnp.int32, jnp.uint32])
def test_division_by_a_constant_zero_is_that_by_an_input(function, dtype):
    """By integers -1, and the dividend remains. XLA itself stops the process at such a constant."""
    x, zero = jnp.array([7, 0, 1], dtype), jnp.zeros(3, dtype)
    expected = jax.vmap(function)(x, zero)
    np.testing.assert_array_equal(fused.vmap(function)(x, zero), expected)
    constant = fused.vmap(lambda x: function(x, dtype(0)))
    np.testing.assert_array_equal(constant(x), expected)
    constant = fused.vmap(lambda x: function(dtype(0), x))
    np.testing.assert_array_equal(constant(x), jax.vmap(function)(zero, x))
    for number, result in zip(np.asarray(x), np.asarray(expected), strict=True):
        both = fused.vmap(lambda x, number=number: function(number, dtype(0)) + 0 * x)
        np.testing.assert_array_equal(both(x), result)


def test_wiring_costs_nothing():
    def fn(x):
        padded = jnp.pad(x.reshape(3, 2).T, ((1, 1), (0, 0)))[1:-1]
        return jnp.concatenate([padded, jnp.zeros((2, 3))]).at[3].add(padded[0] * 0)[:2, 1]

    assert count(fn, jnp.ones(6)) == 0
