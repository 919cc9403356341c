"""Functions to be mapped, and what ``scalar.vmap`` and ``jax.vmap`` must have in common."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import jaxprs, scalarized
from mjx_reinforce.engine.scalar.graph import Graph

BATCH = 6


def batch_of(*shape, seed=0, low=-2.0, high=2.0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(low, high, (BATCH, *shape)), jnp.float32)


def assert_same(fn, *args, in_axes: Any = 0, out_axes: Any = 0, rtol=2e-6, atol=2e-6):
    """``scalar.vmap`` and ``jax.vmap`` compute the same, which is returned."""
    expected = jax.jit(jax.vmap(fn, in_axes, out_axes))(*args)
    actual = jax.jit(scalar.vmap(fn, in_axes, out_axes))(*args)
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    named = jax.tree_util.tree_leaves_with_path(expected)
    for x, (path, y) in zip(jax.tree.leaves(actual), named, strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype), path
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol, err_msg=str(path))
    return expected


def assert_all_same(functions, *args, rtol=2e-6, atol=2e-6):
    """So do many functions in one program; of constants the rules make the same in NumPy."""

    def together(*values):
        return {name: fn(*values) for name, fn in functions.items()}

    expected = assert_same(together, *args, rtol=rtol, atol=atol)
    named = jax.tree_util.tree_leaves_with_path(expected)
    for lane in range(len(args[0])):
        results = folded(together, *(x[lane] for x in args))
        for x, (path, y) in zip(results, named, strict=True):
            assert (x.shape, x.dtype) == (y.shape[1:], y.dtype), path
            np.testing.assert_allclose(x, y[lane], rtol=rtol, atol=atol, err_msg=str(path))


def folded(fn, *args):
    """What the rules make of constants: NumPy computes it, and no node is left."""
    arrays = [np.asarray(x) for x in args]
    program, _ = jaxprs.trace(fn, *arrays)
    with np.errstate(all="ignore"):  # as ``scalarize`` has it
        results = scalarized.run(Graph(400, 4), program, arrays)
    assert all(result.dtype != object for result in results)
    return results


def count(fn, *examples):
    return sum(scalar.scalarize(fn, *examples).operations.values())


def equations(jaxpr):
    """Yields every equation of a jaxpr, inner ones included."""
    for eqn in jaxpr.eqns:
        yield eqn
        for value in eqn.params.values():
            for inner in value if isinstance(value, (list, tuple)) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def primitives(fn, *args):
    """Lists every primitive of a function, inner ones included."""
    return [eqn.primitive.name for eqn in equations(jax.make_jaxpr(fn)(*args).jaxpr)]


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
