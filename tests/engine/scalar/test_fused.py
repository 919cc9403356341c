"""``scalar.vmap`` as a whole, against ``jax.vmap``: axes, errors, sizes, gradients, precision."""

import functools
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax
from mapped import assert_same, batch_of, collatz, equations, line_search

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import graph, size


def test_axes():
    for in_axes, out_axes in [(0, 0), (-1, -1), (1, 1), ((1,), -1), (1, 0)]:
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
    out = {"scaled": 1, "shared": 0, "b": 0}
    assert_same(fn, tree, {"s": jnp.arange(3.0)}, in_axes=axes, out_axes=out)


def test_wrong_axes_are_refused():
    for fn, args, axes, message in [
        (jnp.add, (jnp.ones(3), jnp.ones(4)), {}, "inconsistent sizes"),
        (jnp.add, (jnp.ones(3), jnp.ones(3)), {"in_axes": None}, "at least one"),
        (jnp.sin, (jnp.ones(3),), {"in_axes": 2}, "rank should be at least 3"),
        (jnp.sin, (jnp.ones(3),), {"out_axes": None}, "out_axes"),
    ]:
        with pytest.raises(ValueError, match=message):
            scalar.vmap(fn, **axes)(*args)


def test_closing_over_values_of_an_outer_trace():
    def mapped(scale, x):
        return scalar.vmap(lambda y: jnp.outer(y, scale) + scale[0])(x)

    scale, x = jnp.arange(3.0), batch_of(2)
    expected = jax.vmap(lambda y: jnp.outer(y, scale) + scale[0])(x)
    np.testing.assert_allclose(jax.jit(mapped)(scale, x), expected, rtol=1e-6)


def test_loops_stay_loops_under_an_outer_vmap():
    """An outer vmap must turn neither a loop's predicate nor a branch's into a batched one."""

    def fn(x):
        return lax.cond(x > 1, lambda: collatz((10 * x).astype(jnp.int32))[1], lambda: 0)

    x = jnp.linspace(0.1, 2.0, 12).reshape(3, 4)
    mapped = jax.vmap(scalar.vmap(fn))
    np.testing.assert_array_equal(jax.jit(mapped)(x), jax.vmap(jax.vmap(fn))(x))
    jaxpr = jax.make_jaxpr(mapped)(x).jaxpr
    eqns = [eqn for eqn in equations(jaxpr) if eqn.primitive.name in ("while", "cond")]
    predicates = [
        eqn.params["cond_jaxpr"].jaxpr.outvars[0] if "cond_jaxpr" in eqn.params else eqn.invars[0]
        for eqn in eqns
    ]
    assert [predicate.aval.shape for predicate in predicates] == [(), ()]


def test_any_lane_reduces_over_outer_axes():
    x = jnp.array([[False, False], [False, True]])
    np.testing.assert_array_equal(jax.vmap(scalar.any_lane)(x), [True, True])
    assert not scalar.any_lane(x[0])


@jax.jit
def through_jit(x):
    return jnp.fft.fft(x).real  # itself a jitted function of JAX


def test_unsupported_primitives_name_the_line_of_the_user():
    """Also inside of a jitted function, of a loop, of random numbers."""
    draw = lambda x: jax.random.normal(jax.random.wrap_key_data(x[:2].astype(jnp.uint32)), (2,))  # noqa: E731
    for primitive, function, fn in [
        ("eigh", "<lambda>", lambda x: lax.linalg.eigh(jnp.outer(x, x))[0]),
        ("fft", "through_jit", through_jit),
        ("fft", "through_jit", lambda x: lax.map(through_jit, x[None])),
        ("threefry2x32", "<lambda>", draw),
    ]:
        words = rf"primitive '{primitive}', used at \S*test_fused\.py:\S* \(\S*{function}"
        with pytest.raises(scalar.UnsupportedPrimitive, match=words):
            scalar.vmap(fn)(jnp.ones((2, 4)))


def test_typed_keys_are_refused_in_words():
    keys = jax.random.split(jax.random.key(0), 3)
    draw = lambda key: jax.random.normal(key, (2,))  # noqa: E731
    for fn, args in [
        (draw, (keys,)),
        (lambda key, x: x, (keys, jnp.ones(3))),
        (lambda x: x + draw(keys[0]), (jnp.ones(3),)),
    ]:
        with pytest.raises(scalar.UnsupportedPrimitive, match=r"typed PRNG keys .* jax\.vmap"):
            scalar.vmap(fn)(*args)
    with pytest.raises(scalar.UnsupportedPrimitive, match=r"'random_seed'.*test_fused\.py"):
        scalar.vmap(lambda x: x + draw(jax.random.key(0)))(jnp.ones(3))


def test_what_is_too_large_is_refused_and_what_compiles_long_is_warned_of(monkeypatch):
    def double(x):
        return jnp.sin(x) * 2

    module = importlib.import_module("mjx_reinforce.engine.scalar.vmap")  # hidden by the function
    assert module.MAX_OPERATIONS == 20_000
    monkeypatch.setattr(module, "MAX_OPERATIONS", 39)
    with pytest.warns(UserWarning, match=r"is 40 scalar operations.*use jax\.vmap"):
        jax.eval_shape(scalar.vmap(double), jnp.ones((2, 20)))
    monkeypatch.setattr(size, "MAX_SCALARS", 30)
    with pytest.raises(scalar.TooLarge, match="is about 40 scalar operations, more than 30"):
        scalar.vmap(double)(jnp.ones((2, 20)))
    monkeypatch.setattr(size, "MAX_SCALARS", 40)
    monkeypatch.setattr(graph, "_MAX_NODES", 39)
    with pytest.raises(scalar.TooLarge, match="is more than 39 scalar operations"):
        scalar.vmap(double)(jnp.ones((2, 20)))


def test_gradient():
    def loss(mapped, x):
        return (mapped(lambda y: jnp.sin(y[0]) * y[1] ** 3 / y[0])(x) ** 2).sum()

    x = batch_of(2, low=0.5, high=2)
    gradients = [jax.grad(lambda x, m=m: loss(m, x))(x) for m in (scalar.vmap, jax.vmap)]
    np.testing.assert_allclose(*gradients, rtol=1e-5)


def test_x64():
    with jax.enable_x64(True):
        x = jnp.linspace(0.1, 2, 5)
        assert x.dtype == jnp.float64
        assert_same(lambda x: line_search(x)[0] + 1 / 3, x, rtol=1e-15)


def test_pruned_functions_keep_only_what_they_return():
    def simulate(x):
        unused = jnp.sort(jnp.outer(x, x), axis=0)
        return {"kept": jnp.sin(x), "same": x, "dropped": unused.shape}

    pruned = scalar.prune(lambda x: {k: v for k, v in simulate(x).items() if k != "dropped"})
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(jax.jit(pruned)(x)["kept"], jnp.sin(x))
    np.testing.assert_array_equal(jax.jit(pruned)(x)["same"], x)
    names = [eqn.primitive.name for eqn in jax.make_jaxpr(pruned)(x).eqns]
    assert names == ["sin"]


# -------------------------------------------------------------------------------------------------
# Random programs: ``scalar.vmap`` computes, bit by bit, what ``jax.vmap`` computes.
#
# A program is a list of steps, each of which reads values that are there and adds one. All floats
# are multiples of 1/8 within 8, so that no order of operations rounds, and the results must be
# equal also behind comparisons and conversions.

#: Of the examples at least so many must reach the comparison.
FLOOR = 0.8
BATCH, SIZE = 5, 3


def settle(x):
    """Makes a float a multiple of 1/8 within 8 again."""
    return jnp.clip(jnp.floor(x * 8) / 8, -8.0, 8.0)


def whole(x):
    return jnp.asarray(x, jnp.int32)


#: XLA, not ours, stops the process where it divides a constant by a constant zero.
unknown = lax.optimization_barrier

#: name -> (kinds of the operands, function, kind of the result). Kinds: float, int, bool, vector.
SIMPLE: dict[str, tuple[str, Any, str]] = {
    "add": ("ff", jnp.add, "f"), "sub": ("ff", jnp.subtract, "f"), "mul": ("ff", jnp.multiply, "f"),
    "max": ("ff", jnp.maximum, "f"), "min": ("ff", jnp.minimum, "f"),
    "neg": ("f", jnp.negative, "f"), "abs": ("f", jnp.abs, "f"), "sign": ("f", jnp.sign, "f"),
    "floor": ("f", jnp.floor, "f"), "square": ("f", jnp.square, "f"),
    "cube": ("f", lambda x: x**3, "f"), "quarter": ("f", lambda x: x / 4, "f"),
    "same": ("f", lambda x: x - x, "f"), "opposite": ("ff", lambda x, y: -(x - y), "f"),
    "zero": ("", lambda: jnp.float32(0), "f"), "one": ("", lambda: jnp.float32(1), "f"),
    "minus": ("", lambda: jnp.float32(-1), "f"), "less": ("ff", jnp.less, "b"),
    "equal": ("ff", jnp.equal, "b"), "unequal": ("ff", jnp.not_equal, "b"),
    "at least": ("ii", jnp.greater_equal, "b"), "select": ("bff", jnp.where, "f"),
    "select integer": ("bii", jnp.where, "i"), "select bool": ("bbb", jnp.where, "b"),
    "mask": ("bf", lambda b, x: b * x, "f"),
    "masks": ("bb", lambda b, c: (b * 2.0 - 1.0) * (c * 1.0), "f"),
    "true": ("", lambda: jnp.bool_(True), "b"), "both": ("bb", jnp.logical_and, "b"),
    "either": ("bb", jnp.logical_or, "b"), "one of": ("bb", jnp.logical_xor, "b"),
    "not": ("b", jnp.logical_not, "b"), "add integers": ("ii", jnp.add, "i"),
    "sub integers": ("ii", jnp.subtract, "i"), "mul integers": ("ii", jnp.multiply, "i"),
    "divide": ("ii", lambda i, j: lax.div(i, unknown(j)), "i"),
    "remain": ("ii", lambda i, j: lax.rem(i, unknown(j)), "i"), "and": ("ii", jnp.bitwise_and, "i"),
    "xor": ("ii", jnp.bitwise_xor, "i"), "shift": ("ii", lax.shift_left, "i"),
    "shift back": ("ii", lax.shift_right_arithmetic, "i"), "none": ("", lambda: jnp.int32(0), "i"),
    "bool to integer": ("b", whole, "i"), "float to integer": ("f", whole, "i"),
    "integer to float": ("i", lambda i: jnp.clip(i, -64, 64) / jnp.float32(8), "f"),
    "read": ("vi", lambda v, i: v[i], "f"),
    "read or fill": ("vi", lambda v, i: v.at[i].get(mode="fill", fill_value=0.5), "f"),
    "write": ("vif", lambda v, i, x: v.at[i].set(x), "v"),
    "add to": ("vif", lambda v, i, x: v.at[i].add(x), "v"),
    "slice": ("vi", lambda v, i: lax.dynamic_slice(v, (i,), (2,)).sum(), "f"),
    "sum": ("v", jnp.sum, "f"), "largest": ("v", jnp.max, "f"),
    "where largest": ("v", lambda v: whole(v.argmax()), "i"), "sort": ("v", jnp.sort, "v"),
    "cumulate": ("v", jnp.cumsum, "v"), "dot": ("vv", jnp.dot, "f"),
    "scale": ("vf", jnp.multiply, "v"), "stack": ("fff", lambda *xs: jnp.stack(xs), "v"),
}  # fmt: skip


def carry_of(values):
    return values["f"][-1], values["i"][-1], values["b"][-1]


def inner(program, values, carry, row=None):
    """Runs a program inside of a loop or a branch; returns its last float, integer and bool."""
    inside = {kind: list(known) for kind, known in values.items()}
    for kind, value in zip("fib", carry, strict=True):
        inside[kind].append(value)
    if row is not None:
        inside["f"].append(row)
    return carry_of(execute(program, inside))


def branch(values, programs, number):
    carry = carry_of(values)
    bodies = [functools.partial(inner, program, values) for program in programs]
    if number % 2:
        return lax.switch(values["i"][-1], bodies, carry)
    return lax.cond(carry[2], *bodies[:2], carry)


def repeat(values, programs, number):
    """A loop that ends by what the lane holds."""

    def goes_on(state):
        count, (x, _, flag) = state
        return (count < number) & ((x < 4) | flag)

    def step(state):
        count, carry = state
        return count + 1, inner(programs[0], values, carry)

    return lax.while_loop(goes_on, step, (jnp.int32(0), carry_of(values)))[1]


def scan(values, programs, number):
    """A loop of a fixed length, which reads a vector and makes one, or does not."""
    if number % 2:
        step = lambda carry, _: (inner(programs[0], values, carry), None)  # noqa: E731
        return lax.scan(step, carry_of(values), None, length=number)[0]

    def step_row(carry, row):
        after = inner(programs[0], values, carry, row)
        return after, after[0]

    rows = jnp.tile(values["v"][-1], 1 + number // 4)
    carry, kept = lax.scan(step_row, carry_of(values), rows, reverse=number % 4 == 2)
    values["v"].append(kept[:SIZE])
    return carry


def execute(program, values):
    """Runs a program; adds what its steps make to the values, and returns them."""
    for step, numbers, programs in program:
        if callable(step):
            for kind, value in zip("fib", step(values, programs, numbers[0]), strict=True):
                values[kind].append(value)
            continue
        kinds, function, made = SIMPLE[step]
        chosen = zip(kinds, numbers, strict=False)
        result = function(*(values[kind][-1 - n % len(values[kind])] for kind, n in chosen))
        values[made].append(settle(result) if made in "fv" else result)
    return values


def as_function(program):
    def function(x, v, i, b):
        values = execute(program, {"f": [x], "v": [v], "i": [i], "b": [b]})
        return {kind: known[-3:] for kind, known in values.items()}

    return function


NUMBERS = st.tuples(*[st.integers(0, 7)] * 3)
STEP = st.tuples(st.sampled_from(list(SIMPLE)), NUMBERS, st.none())


def control(program):
    return st.tuples(st.sampled_from([branch, repeat, scan]), NUMBERS, st.tuples(*[program] * 3))


#: Simple steps, a loop or a branch, of which the bodies may have others, and steps that read it.
BODY = st.lists(STEP, min_size=1, max_size=4)
NESTED = st.lists(STEP | control(BODY), min_size=1, max_size=4)
PROGRAMS = st.builds(
    lambda before, middle, after: [*before, middle, *after],
    *(st.lists(STEP, min_size=2, max_size=5), control(NESTED), st.lists(STEP, max_size=5)),
)


@pytest.mark.slow
def test_random_programs_compute_what_jax_computes():
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.integers(-64, 65, BATCH) / 8, jnp.float32)
    v = jnp.asarray(rng.integers(-64, 65, (BATCH, SIZE)) / 8, jnp.float32)
    i, b = jnp.array([-5, 0, 1, 2, 9], jnp.int32), jnp.array([True, False, True, False, True])
    tried, compared = [], []

    @settings(
        max_examples=16,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(PROGRAMS)
    def check(program):
        function = as_function(program)
        tried.append(program)
        expected = jax.jit(jax.vmap(function))(x, v, i, b)
        try:
            actual = jax.jit(scalar.vmap(function, branch_cost=4))(x, v, i, b)
        except (scalar.TooLarge, scalar.UnsupportedPrimitive):
            return
        for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs)
        compared.append(program)

    check()
    assert len(compared) >= FLOOR * len(tried)
