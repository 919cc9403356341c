"""The fused evaluator against `jax.vmap`, primitive by primitive and loop by loop."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce import fused
from mjx_reinforce.fused import graph, jaxprs, scalarized, size

BATCH = 6


def batch_of(*shape, seed=0, low=-2.0, high=2.0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(low, high, (BATCH, *shape)), jnp.float32)


def assert_same(fn, *args, in_axes: Any = 0, out_axes: Any = 0, rtol=2e-6, atol=2e-6):
    expected = jax.vmap(fn, in_axes, out_axes)(*args)
    actual = jax.jit(fused.vmap(fn, in_axes, out_axes))(*args)
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


def count(fn, *examples):
    return sum(fused.scalarize(fn, *examples).operations.values())


def primitives(jaxpr):
    """Lists every primitive of a jaxpr, inner ones included."""
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for value in eqn.params.values():
            for inner in value if isinstance(value, (list, tuple)) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from primitives(inner)


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


@pytest.mark.parametrize(("in_axes", "out_axes"), [(0, 0), (-1, -1), (1, 1), ((1,), -1), (1, 0)])
def test_axes(in_axes, out_axes):
    assert_same(lambda x: x * 2 + x[0], jnp.ones((4, 4)), in_axes=in_axes, out_axes=out_axes)


def test_axes_of_pytrees_and_shared_arguments():
    def fn(tree, scale):
        return {
            "scaled": tree["a"] * scale["s"],
            "shared": scale["s"] + 1,
            "b": tree["b"] @ tree["a"],
        }

    tree = {"a": batch_of(3).T, "b": batch_of(3)}
    axes = ({"a": -1, "b": 0}, None)
    out = {"scaled": 1, "shared": None, "b": 0}
    assert_same(fn, tree, {"s": jnp.arange(3.0)}, in_axes=axes, out_axes=out)


def test_wrong_axes_are_refused():
    with pytest.raises(ValueError, match="one size"):
        fused.vmap(jnp.add)(jnp.ones(3), jnp.ones(4))
    with pytest.raises(ValueError, match="one size"):
        fused.vmap(jnp.add, in_axes=None)(jnp.ones(3), jnp.ones(3))
    with pytest.raises(ValueError, match="axis 2"):
        fused.vmap(jnp.sin, in_axes=2)(jnp.ones(3))
    with pytest.raises(ValueError, match="out_axes"):
        fused.vmap(jnp.sin, out_axes=None)(jnp.ones(3))


def test_closing_over_values_of_an_outer_trace():
    def mapped(scale, x):
        return fused.vmap(lambda y: jnp.outer(y, scale) + scale[0])(x)

    scale, x = jnp.arange(3.0), batch_of(2)
    expected = jax.vmap(lambda y: jnp.outer(y, scale) + scale[0])(x)
    np.testing.assert_allclose(jax.jit(mapped)(scale, x), expected, rtol=1e-6)


def collatz(n):
    return lax.while_loop(
        lambda s: s[0] != 1,
        lambda s: (jnp.where(s[0] % 2 == 0, s[0] // 2, 3 * s[0] + 1), s[1] + 1),
        (n, 0),
    )


def line_search(x, length=50):
    """A scan of cond(active, iterate, identity), like MJX's."""

    def iterate(state):
        y, i = state
        y = 0.5 * (y + x / y)
        return (y, i + 1), jnp.abs(y * y - x) > 1e-4

    def body(carry, i):
        state, active = carry
        return lax.cond(active, iterate, lambda s: (s, False), state), i

    return lax.scan(body, ((x, 0), jnp.array(True)), None, length=length)[0][0]


LOOPS = [
    lambda x: lax.fori_loop(0, 20, lambda i, y: 0.9 * y + i, x),
    lambda x: lax.fori_loop(0, (10 * x).astype(jnp.int32), lambda i, y: y + i, x),
    lambda x: collatz(1 + (20 * x).astype(jnp.int32)),
    line_search,
    lambda x: lax.scan(lambda c, y: (c * y, c + y), x, jnp.arange(1.0, 4.0)),
    lambda x: lax.scan(lambda c, y: (0.5 * c + y, c + y), x, x * jnp.arange(12.0)),
    lambda x: lax.scan(lambda c, y: (c - y, (c, 3.0)), x, jnp.arange(9.0), reverse=True),
    lambda x: lax.scan(lambda c, _: (c, c), x, None, length=0),
    lambda x: lax.map(lambda y: y * x, jnp.arange(7.0)),
    lambda x: lax.while_loop(lambda y: y > 10, lambda y: y + 1, jnp.abs(x)),
    lambda x: lax.fori_loop(
        0, 6, lambda i, y: lax.while_loop(lambda z: z < y[0], lambda z: z + x, 0.0) + y * 0.9,
        jnp.array([x, 1.0]),
    ),
]  # fmt: skip


@pytest.mark.parametrize("fn", LOOPS)
def test_loops(fn):
    assert_same(fn, batch_of(low=0.3, high=3), rtol=1e-5)


def heavy(x):
    return lax.fori_loop(0, 30, lambda _, y: jnp.cos(y) * x, x)


BRANCHES = [
    lambda x: lax.cond(x > 0, jnp.sin, jnp.cos, x),
    lambda x: lax.cond(x > 0, heavy, jnp.cos, x),
    lambda x: lax.cond(x > 0, jnp.cos, heavy, x),
    lambda x: lax.cond(x > 0, heavy, lambda y: heavy(2 * y), x),
    lambda x: lax.switch((x + 2).astype(jnp.int32) - 1, [jnp.sin, heavy, jnp.cos, lambda y: y], x),
    lambda x: lax.cond(x > 0, lambda: lax.cond(x > 1, heavy, jnp.sin, x), lambda: x),
    lambda x: lax.cond(True, jnp.sin, jnp.cos, x),
    lambda x: lax.fori_loop(0, 9, lambda i, y: lax.cond(y > 1, heavy, jnp.exp, y), x),
]


@pytest.mark.parametrize("fn", BRANCHES)
def test_branches(fn):
    assert_same(fn, batch_of(), rtol=1e-5)


def test_line_search_becomes_a_loop_that_ends():
    written = fused.scalarize(line_search, jnp.ones(()))
    assert sum(written.operations.values()) < 25
    jaxpr = jax.make_jaxpr(fused.vmap(line_search))(jnp.ones(4)).jaxpr
    names = list(primitives(jaxpr))
    assert "while" in names
    assert "scan" not in names
    assert "cond" not in names


def test_a_switch_that_does_not_freeze_everything_is_not_taken_for_one():
    def fn(x):
        def body(carry, _):
            y, active = carry
            return (y + 1, active & (y < 3)), None  # y goes on when active is False

        return lax.scan(body, (x, jnp.array(True)), None, length=20)[0]

    assert_same(fn, batch_of())


def test_loops_stay_loops_under_an_outer_vmap():
    """An outer vmap must turn neither a loop's predicate nor a branch's into a batched one."""

    def fn(x):
        return lax.cond(x > 1, lambda: collatz((10 * x).astype(jnp.int32))[1], lambda: 0)

    x = jnp.linspace(0.1, 2.0, 12).reshape(3, 4)
    mapped = jax.vmap(fused.vmap(fn))
    np.testing.assert_array_equal(jax.jit(mapped)(x), jax.vmap(jax.vmap(fn))(x))
    closed = jax.make_jaxpr(mapped)(x)
    found = []

    def visit(jaxpr):
        for eqn in jaxpr.eqns:
            if eqn.primitive.name == "while":
                found.append(eqn.params["cond_jaxpr"].jaxpr.outvars[0].aval.shape)
            if eqn.primitive.name == "cond":
                found.append(eqn.invars[0].aval.shape)
            for value in eqn.params.values():
                for inner in value if isinstance(value, (list, tuple)) else [value]:
                    inner = getattr(inner, "jaxpr", inner)
                    if hasattr(inner, "eqns"):
                        visit(inner)

    visit(closed.jaxpr)
    assert found == [(), ()]


def test_any_lane_reduces_over_outer_axes():
    x = jnp.array([[False, False], [False, True]])
    np.testing.assert_array_equal(jax.vmap(fused.any_lane)(x), [True, True])
    assert not fused.any_lane(x[0])


# Not the loops over an integer made of x: what NaN converts to is not defined.
@pytest.mark.parametrize("fn", [LOOPS[0], line_search, *BRANCHES])
def test_a_nan_stays_in_its_lane(fn):
    x = np.array(batch_of(low=0.3, high=1.5))
    mapped = jax.jit(fused.vmap(fn))
    clean = jax.tree.leaves(mapped(x))
    x[2] = np.nan
    for dirty, reference in zip(jax.tree.leaves(mapped(x)), clean, strict=True):
        np.testing.assert_array_equal(np.delete(dirty, 2, 0), np.delete(reference, 2, 0))


def test_known_deviation_of_a_constant_zero():
    """Documented: a product with a constant zero is zero, whatever the other factor is."""
    assert fused.vmap(lambda x: x * 0.0)(jnp.array([jnp.nan]))[0] == 0


def test_wiring_costs_nothing():
    def fn(x):
        padded = jnp.pad(x.reshape(3, 2).T, ((1, 1), (0, 0)))[1:-1]
        return jnp.concatenate([padded, jnp.zeros((2, 3))]).at[3].add(padded[0] * 0)[:2, 1]

    assert count(fn, jnp.ones(6)) == 0


def test_constants_fold_and_common_subexpressions_are_shared():
    def fn(x):
        matrix = jnp.array([[0.0, 1.0], [2.0, 0.0]])
        return matrix @ x + jnp.sin(jnp.ones(2)) * 0 + jnp.sin(x[0]) + jnp.sin(x[0])

    # one product by 2, one sine, and in each of two elements the two sums with the sine
    assert count(fn, jnp.ones(2)) == 6


def test_unused_results_are_not_computed():
    def fn(x):
        state = (x, jnp.sin(x), x)
        body = lambda i, s: (s[0] * 0.5, jnp.exp(s[1]), s[2])  # noqa: E731
        return lax.fori_loop(0, 40, body, state)[0]

    assert count(fn, 1.0) == 1


def test_unsupported_primitive_names_itself_and_its_line():
    with pytest.raises(fused.UnsupportedPrimitive, match=r"'eigh'.*test_fused\.py"):
        fused.vmap(lambda x: lax.linalg.eigh(x)[0])(jnp.ones((2, 3, 3)))


SIZES = {
    "elementwise": (lambda x: jnp.sin(x) + x, 12),
    "product": (lambda x: x @ x.T, 2 * 9 * 4),
    "reduction": (lambda x: x.sum(), 12),
    "branches": (lambda x: lax.cond(x[0, 0] > 0, jnp.sin, lambda x: x * 2, x), 12),
    "loop": (lambda x: lax.fori_loop(0, 40, lambda _, x: jnp.sin(x) * 2, x), 24),
    "while": (lambda x: lax.while_loop(lambda x: x[0, 0] < 9, lambda x: x + 1, x), 24),
}


@pytest.mark.parametrize("name", SIZES)
def test_the_size_is_known_before_anything_is_written(name):
    fn, least = SIZES[name]
    program, _ = jaxprs.trace(fn, jnp.ones((3, 4)))
    assert least <= size.num_scalars(program) <= 2 * least + 15


def test_what_is_too_large_is_refused_and_what_compiles_long_is_warned_of(monkeypatch):
    def double(x):
        return jnp.sin(x) * 2

    with pytest.warns(UserWarning, match=r"is 20,002 scalar operations.*use jax\.vmap"):
        jax.eval_shape(fused.vmap(double), jnp.ones((2, 10_001)))
    monkeypatch.setattr(size, "MAX_SCALARS", 30)
    with pytest.raises(fused.TooLarge, match="is about 40 scalar operations, more than 30"):
        fused.vmap(double)(jnp.ones((2, 20)))
    monkeypatch.setattr(size, "MAX_SCALARS", 40)
    monkeypatch.setattr(graph, "_MOST", 39)
    with pytest.raises(fused.TooLarge, match="is more than 39 scalar operations"):
        fused.vmap(double)(jnp.ones((2, 20)))


def test_gradient():
    def loss(mapped, x):
        return (mapped(lambda y: jnp.sin(y[0]) * y[1] ** 3 / y[0])(x) ** 2).sum()

    x = batch_of(2, low=0.5, high=2)
    gradients = [jax.grad(lambda x, m=m: loss(m, x))(x) for m in (fused.vmap, jax.vmap)]
    np.testing.assert_allclose(*gradients, rtol=1e-5)


def test_x64():
    with jax.enable_x64(True):
        x = jnp.linspace(0.1, 2, 5)
        assert x.dtype == jnp.float64
        assert_same(lambda x: line_search(x)[0] + 1 / 3, x, rtol=1e-15)


def test_short_loops_can_stay_loops():
    step = lambda _, x: jnp.sin(x) + x  # noqa: E731
    counts = [
        scalarized.build(
            lambda x: lax.fori_loop(0, 3, step, x), (jnp.ones(()),), [True], 400, unrolled
        ).operations["sin"]
        for unrolled in (4, 1)
    ]
    assert counts == [3, 1]


def test_a_scan_that_asks_to_be_unrolled_is_written_out_up_to_a_length():
    def total(x, unroll):
        step = lambda carry, row: (carry + jnp.sin(row), None)  # noqa: E731
        return lax.scan(step, 0.0, x, unroll=unroll)[0]

    def sines(unroll, on_request):
        written = scalarized.build(
            functools.partial(total, unroll=unroll),
            (jnp.ones(7),),
            [True],
            400,
            unrolled=1,
            unrolled_arrays=1,
            unrolled_on_request=on_request,
        )
        return written.operations["sin"]

    assert [sines(1, 7), sines(2, 6), sines(2, 7), sines(7, 1)] == [1, 1, 7, 7]


def test_pruned_functions_keep_only_what_they_return():
    def simulate(x):
        unused = jnp.sort(jnp.outer(x, x), axis=0)
        return {"kept": jnp.sin(x), "same": x, "dropped": unused.shape}

    pruned = fused.prune(lambda x: {k: v for k, v in simulate(x).items() if k != "dropped"})
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(jax.jit(pruned)(x)["kept"], jnp.sin(x))
    np.testing.assert_array_equal(jax.jit(pruned)(x)["same"], x)
    names = [eqn.primitive.name for eqn in jax.make_jaxpr(pruned)(x).eqns]
    assert names == ["sin"]
