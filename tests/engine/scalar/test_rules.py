"""The rules for arrays: what JAX computes, on lanes and on constants, in few operations."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import BATCH, assert_all_same, batch_of, count, folded

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS
from mjx_reinforce.engine.scalar.rules import structural

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
    lambda x: lax.pow(x, np.arange(4, dtype=np.int32)),
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

        by_input, by_constant, of_constant, constants = scalar.vmap(divided)(x, zero)
        np.testing.assert_array_equal(by_input, expected[0])
        np.testing.assert_array_equal(by_constant, expected[0])
        np.testing.assert_array_equal(of_constant, expected[1])
        np.testing.assert_array_equal([row[0] for row in constants], expected[0][jnp.array([0, 2])])


def test_what_costs_nothing_or_little():
    assert count(lambda x: lax.convert_element_type(x, jnp.float32), jnp.ones(3)) == 0
    assert count(lambda x: x**8, jnp.float32(1)) == 3
    assert count(lax.square, jnp.ones(3)) == 3


def test_bits_of_another_size_are_refused():
    with pytest.raises(UnsupportedPrimitive, match="bitcast_convert_type to another size"):
        scalar.scalarize(lambda x: lax.bitcast_convert_type(x, jnp.int8), jnp.ones(3))


def test_every_operation_has_the_general_rule_or_one_of_its_own():
    assert OP_TRAITS.keys() <= structural.RULES.keys()


MOVES = {
    "slice": lambda x: lax.slice(x, (0, 1), (3, 4), (2, 1)),
    "slice without strides": lambda x: lax.slice(x, (1, 1), (3, 3)),
    "reshape": lambda x: x.reshape(2, 6),
    "squeeze": lambda x: lax.squeeze(x[:1], (0,)),
    "expand_dims": lambda x: lax.expand_dims(x, (0, 2)),
    "broadcast_in_dim": lambda x: lax.broadcast_in_dim(x, (3, 2, 4), (0, 2)),
    "transpose": lambda x: lax.transpose(x, (1, 0)),
    "rev": lambda x: lax.rev(x, (1,)),
    "tile": lambda x: jnp.tile(x, (2, 3)),
    "concatenate": lambda x: lax.concatenate([x, jnp.ones((1, 4)), x[:1]], 0),
    "stack": lambda x: jnp.stack([x, np.ones((3, 4), np.float32)], axis=1),
    "unstack": list,
    "split": lambda x: lax.split(x, (1, 3), axis=1),
    "pad": lambda x: lax.pad(x, jnp.float32(9), ((1, 0, 2), (0, 2, 0))),
    "pad less": lambda x: lax.pad(x, jnp.float32(9), ((-1, 1, 1), (2, -3, 0))),
    "iota": lambda x: lax.broadcasted_iota(jnp.int32, (2, 3), 1),
    "copy": lambda x: lax.optimization_barrier(jnp.copy(lax.stop_gradient(x))),
    "results of any kind": lambda x: {"a": x, "b": (x[0], None, jnp.ones(2))},
}


def test_elements_are_moved_and_nothing_is_computed():
    assert_all_same(MOVES, batch_of(3, 4), rtol=0, atol=0)
    assert [name for name, fn in MOVES.items() if count(fn, jnp.ones((3, 4)))] == []


PLACES = np.array([2, -1, 7, 0], np.int32)  # of which two are outside an axis of three
TWICE = np.array([0, 0, 2])


def taken(x, i, mode):
    return x.at[i].get(mode=mode), x.at[:, i].get(mode=mode), x.at[i, 1].get(mode=mode)


#: Functions of x [3, 4] and of a place that a lane knows alone.
WINDOWS = {
    f"take, {mode}": lambda x, i, mode=mode: (taken(x, PLACES, mode), taken(x, i, mode))
    for mode in ("clip", "fill")
}
WINDOWS |= {
    f"{change}, {mode}": lambda x, i, change=change, mode=mode: (
        getattr(x.at[PLACES[:3]], change)(2.5, mode=mode),
        getattr(x.at[i], change)(0.5, mode=mode),
    )
    for change, mode in itertools.product(
        ("set", "add", "subtract", "multiply", "min", "max"), ("clip", "drop")
    )
}
WINDOWS |= {
    f"a window at {start}": lambda x, i, start=start: (
        lax.dynamic_slice(x, start, (2, 3)),
        lax.dynamic_update_slice(x, -x[:2, :3], start),
    )
    for start in ((0, 0), (1, 2), (9, -9))
}
WINDOWS |= {
    "the fill value of a dtype": lambda x, i: [
        x.astype(kind).at[np.array([5])].get(mode="fill")
        for kind in (np.int32, np.uint8, bool, np.float32)
    ],
    "a fill value": lambda x, i: x.at[PLACES].get(mode="fill", fill_value=7.0),
    "a window at a place": lambda x, i: lax.dynamic_slice(x, (i, i), (2, 2)),
    "a window is written": lambda x, i: lax.dynamic_update_slice(x, x[:1, :2], (i, i)),
    "two places": lambda x, i: (x[i, i + 1], x[i, :2], x.at[1:3, i].max(0.2)),
    "columns": lambda x, i: x.at[:, i].add(x[:, 0]),
    "an entry that is named twice": lambda x, i: (x.at[TWICE].add(1.0), x.at[TWICE, 1].mul(3.0)),
    "no place": lambda x, i: (x.at[TWICE[:0]].set(1.0), x.at[TWICE[:0], 1].add(1.0)),
    "each row its own": lambda x, i: (
        jnp.take_along_axis(x, TWICE[:, None], axis=1),
        jax.vmap(lambda row, k: row[k])(x, TWICE),
        x[np.arange(3), TWICE],
    ),
}


@pytest.mark.slow
def test_windows_are_read_and_changed():
    assert_all_same(WINDOWS, batch_of(3, 4), jnp.int32([-5, -1, 0, 1, 2, 7]))


def test_known_places_cost_nothing():
    assert count(lambda x: x[np.array([2, 0, 1])], jnp.ones(3)) == 0
    assert count(lambda x, i: x[i], jnp.ones(3), jnp.int32(0)) > 0


PRODUCTS = {
    "matrices": lambda a, b: jnp.matmul(a, b),
    "transposed": lambda a, b: jnp.einsum("bij,bkj->ik", a, a),
    "batch behind": lambda a, b: jnp.einsum("bij,bjk->kbi", a, b),
    "mapped": lambda a, b: jax.vmap(jnp.dot)(a[0], a[1]),
    "vectors": lambda a, b: jnp.dot(a[0, 0], a[0, 1]),
    "a dtype that was asked for": lambda a, b: lax.dot(
        (60 * a[0]).astype(jnp.int8), (60 * a[1]).astype(jnp.int8), preferred_element_type=jnp.int32
    ),
    "Cholesky": lambda a, b: lax.linalg.cholesky(
        a @ a.swapaxes(1, 2) + 3 * jnp.eye(3), symmetrize_input=False
    ),
    "symmetrized": lambda a, b: jnp.linalg.cholesky(a[0].T + a[0] + 9 * jnp.eye(3)),
}


def solver(left_side, lower, transpose_a, unit_diagonal):
    """Solves triangular systems, whose matrix has other numbers beside the triangle."""

    def solve(a, b):
        return lax.linalg.triangular_solve(
            a + 3 * jnp.eye(3), b if left_side else b.swapaxes(1, 2), left_side=left_side,
            lower=lower, transpose_a=transpose_a, unit_diagonal=unit_diagonal,
        )  # fmt: skip

    return solve


PRODUCTS |= {
    f"left {case[0]}, lower {case[1]}, transposed {case[2]}, unit {case[3]}": solver(*case)
    for case in itertools.product([False, True], repeat=4)
}


@pytest.mark.slow
def test_products_factors_and_triangular_systems():
    assert_all_same(PRODUCTS, batch_of(2, 3, 3)[:2], batch_of(2, 3, 4)[:2], rtol=1e-4, atol=1e-5)


def test_a_product_of_n_m_k_is_so_many_operations():
    assert count(jnp.matmul, jnp.ones((2, 3)), jnp.ones((3, 4))) == 2 * 4 * (3 + 2)


def test_what_is_not_positive_definite_is_nan_from_there_on():
    matrix = np.array([[4, 2, 0], [2, 1, 0], [0, 0, -1]], np.float32)
    (factor,) = folded(lambda x: lax.linalg.cholesky(x, symmetrize_input=False), matrix)
    assert factor[0].tolist() == [2, 0, 0]
    assert np.isnan(factor[2, 2])


#: Whole numbers, so that no order of a sum rounds otherwise; some of a row are equal.
WHOLE_NUMBERS = np.random.default_rng(0).integers(-4, 5, (BATCH, 2, 4)).astype(np.float32)
NAN, INFINITY = np.nan, np.inf
ROW = np.float32([NAN, 1, INFINITY, -INFINITY, -NAN, -0.0, 0.0, -0.0, 0.0, 1, 2, 2])
ROWS = np.stack([np.roll(ROW, shift) for shift in range(BATCH)])


def of_each(function, values):
    return {f"{function.__name__} {value}": (function, value) for value in values}


REDUCTIONS = {
    name: lambda x, row, reduce=reduce, axis=axis: (
        reduce(x, axis=axis),
        reduce(x.astype(jnp.int32), axis=axis),
    )
    for each in (jnp.sum, jnp.prod, jnp.max, jnp.min)
    for name, (reduce, axis) in of_each(each, (None, 0, 1)).items()
}
REDUCTIONS |= {
    name: lambda x, row, cumulate=cumulate, reverse=reverse: [
        cumulate(x, axis, reverse) for axis in (0, 1)
    ]
    for each in (lax.cumsum, lax.cumprod, lax.cummax, lax.cummin)
    for name, (cumulate, reverse) in of_each(each, (False, True)).items()
}
REDUCTIONS |= {
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


@pytest.mark.slow
def test_reductions_prefixes_and_orders():
    assert_all_same(REDUCTIONS, WHOLE_NUMBERS, ROWS, rtol=0, atol=0)


def test_a_sum_is_from_the_first_to_the_last():
    (total,) = folded(jnp.sum, np.float32([1e8, 1, -1e8, 1]))
    assert total == np.float32(np.float32(np.float32(1e8 + 1) - 1e8) + 1) == 1
