"""Rules that combine the elements of an array: what JAX computes, bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mapped import BATCH, assert_all_same, folded

#: Whole numbers, so that no order of a sum rounds otherwise; some of a row are equal.
X = np.random.default_rng(0).integers(-4, 5, (BATCH, 2, 4)).astype(np.float32)
NAN, INFINITY = np.nan, np.inf
ROW = np.float32([NAN, 1, INFINITY, -INFINITY, -NAN, -0.0, 0.0, -0.0, 0.0, 1, 2, 2])
ROWS = np.stack([np.roll(ROW, shift) for shift in range(BATCH)])


def of_each(function, values):
    return {f"{function.__name__} {value}": (function, value) for value in values}


CASES = {
    name: lambda x, row, reduce=reduce, axis=axis: (
        reduce(x, axis=axis),
        reduce(x.astype(jnp.int32), axis=axis),
    )
    for each in (jnp.sum, jnp.prod, jnp.max, jnp.min)
    for name, (reduce, axis) in of_each(each, (None, 0, 1)).items()
}
CASES |= {
    name: lambda x, row, cumulate=cumulate, reverse=reverse: [
        cumulate(x, axis, reverse) for axis in (0, 1)
    ]
    for each in (lax.cumsum, lax.cumprod, lax.cummax, lax.cummin)
    for name, (cumulate, reverse) in of_each(each, (False, True)).items()
}
CASES |= {
    "all": lambda x, row: (x > 0).all(1),
    "any": lambda x, row: (x > 3).any(),
    "xor": lambda x, row: lax.reduce_xor(x > 0, (1,)),
    "a sum of nothing": lambda x, row: x[:, :0].sum(),
    "a product of nothing": lambda x, row: x[:, :0].prod(),
    # The first of equal ones; the first NaN where there is one.
    "argmax": lambda x, row: (jnp.argmax(x, 0), jnp.argmax(x.astype(int), 1), jnp.argmax(row)),
    "argmin": lambda x, row: (jnp.argmin(x, 0), jnp.argmin(x.astype(int), 1), jnp.argmin(row)),
    "sort": lambda x, row: (jnp.sort(x, 1), jnp.sort(x, 0)[::-1], jnp.sort(row)),
    "a stable order": lambda x, row: jnp.argsort(x.ravel().astype(int)),
    "an order by two keys": lambda x, row: lax.sort((x[0], x[1], jnp.arange(4.0)), num_keys=2),
    # By their bits: 0 above -0, NaN above infinity; the first of equal ones is the first.
    "the largest": lambda x, row: [lax.top_k(row, k) for k in (0, 1, 3, 11)],
    "the largest of rows": lambda x, row: (lax.top_k(x, 3), lax.top_k(x.astype(int).ravel(), 8)),
}


def test_reductions_prefixes_and_orders():
    assert_all_same(CASES, X, ROWS, rtol=0, atol=0)


def test_a_sum_is_from_the_first_to_the_last():
    (total,) = folded(jnp.sum, np.float32([1e8, 1, -1e8, 1]))
    assert total == np.float32(np.float32(np.float32(1e8 + 1) - 1e8) + 1) == 1


def test_prefixes_of_logarithms():
    """Of infinite and equal terms, and of NaN, too."""
    inf = INFINITY
    x = [[0, 1, -inf, 3], [-inf, -inf, 1, 2], [inf, inf, 1, 2], [inf, -inf, 1, 2], [NAN, 1, 2, 3]]
    assert_all_same({"": jax.lax.cumlogsumexp}, np.float32(x))
