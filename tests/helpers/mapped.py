"""Functions to be mapped, and what ``fused.vmap`` and ``jax.vmap`` must have in common."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce import fused
from mjx_reinforce.fused import evaluate, jaxprs
from mjx_reinforce.fused.graph import Graph, Limits

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


def folded(fn, *args):
    """What the rules make of constants: NumPy computes it, and no node is left."""
    arrays = [np.asarray(x) for x in args]
    program, _ = jaxprs.trace(fn, *arrays)
    with np.errstate(all="ignore"):  # as ``scalarize`` has it
        results = evaluate.run(Graph(400, Limits()), program, arrays)
    assert all(result.dtype != object for result in results)
    return results


def assert_folds(fn, *args, rtol=0.0):
    """The rules make of constants what JAX computes, in its shapes and dtypes."""
    results, expected = folded(fn, *args), jax.tree.leaves(fn(*map(jnp.asarray, args)))
    for x, y in zip(results, expected, strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=0)


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
