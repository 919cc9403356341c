"""``scalar.vmap`` as a whole, against ``jax.vmap``: axes, errors, sizes, gradients, precision."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_same, batch_of, collatz, equations, line_search

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import graph, jaxprs, size


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
        (jnp.add, (jnp.ones(3), jnp.ones(4)), {}, "one size"),
        (jnp.add, (jnp.ones(3), jnp.ones(3)), {"in_axes": None}, "one size"),
        (jnp.sin, (jnp.ones(3),), {"in_axes": 2}, "axis 2"),
        (jnp.sin, (jnp.ones(3),), {"out_axes": None}, "axis None"),
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
    """Also inside of a jitted function, of a loop, of random numbers, of a choice by engine."""
    draw = lambda x: jax.random.normal(jax.random.wrap_key_data(x[:2].astype(jnp.uint32)), (2,))  # noqa: E731
    for primitive, function, fn in [
        ("eigh", "<lambda>", lambda x: lax.linalg.eigh(jnp.outer(x, x))[0]),
        ("fft", "through_jit", through_jit),
        ("fft", "through_jit", lambda x: lax.map(through_jit, x[None])),
        ("threefry2x32", "<lambda>", draw),
        ("fft", "through_jit", lambda x: scalar.by_engine(through_jit, jnp.sin, x)),
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


SIZES = {
    "elementwise": (lambda x: jnp.sin(x) + x, 12),
    "product": (lambda x: x @ x.T, 2 * 9 * 4),
    "reduction": (lambda x: x.sum(), 12),
    "branches": (lambda x: lax.cond(x[0, 0] > 0, jnp.sin, lambda x: x * 2, x), 12),
    "loop": (lambda x: lax.fori_loop(0, 40, lambda _, x: jnp.sin(x) * 2, x), 24),
    "while": (lambda x: lax.while_loop(lambda x: x[0, 0] < 9, lambda x: x + 1, x), 24),
}


def test_the_size_is_known_before_anything_is_written():
    sizes = {
        name: size.num_scalars(jaxprs.trace(fn, jnp.ones((3, 4)))[0])
        for name, (fn, _) in SIZES.items()
    }
    off = {n: x for n, x in sizes.items() if not SIZES[n][1] <= x <= 2 * SIZES[n][1] + 15}
    assert off == {}


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
    monkeypatch.setattr(graph, "_MOST", 39)
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
