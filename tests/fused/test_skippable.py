"""A computation that changes nothing where it is not needed, by JAX and written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import fused
from mjx_reinforce.fused import jaxprs, size


def plus_sine(x):
    """Adds the sine, of which that of 0 changes nothing."""
    return fused.skippable(x != 0, lambda: {"y": x + jnp.sin(x)}, {"y": x})["y"]


X = jnp.array([0.0, 1.0, -2.0])


def test_results():
    """By JAX, and written out with a branch and without one; of one example too."""
    for transformed in (
        jax.vmap(plus_sine),
        jax.jit(jax.vmap(plus_sine)),
        fused.vmap(plus_sine, branch_cost=0),
        fused.vmap(plus_sine, branch_cost=10_000),
    ):
        np.testing.assert_allclose(transformed(X), X + jnp.sin(X), rtol=1e-6)
    assert plus_sine(jnp.float32(2)) == 2 + jnp.sin(jnp.float32(2))
    assert jax.jit(plus_sine)(jnp.float32(0)) == 0


def test_where_it_is_known_whether_it_is_needed():
    for needed in (True, False):
        both = fused.vmap(lambda x, n=needed: fused.skippable(jnp.array(n), lambda: x * 2, x))
        np.testing.assert_array_equal(both(jnp.ones(3)), [1.0 + needed] * 3)


def test_nothing_is_selected():
    """Of ``lax.cond`` each lane's own result is."""

    def sines(x):
        return sum(jnp.sin(x * k) for k in range(1, 9))

    def skipping(x):
        return fused.skippable(x != 0, lambda: sines(x), jnp.zeros(()))

    def choosing(x):
        return jax.lax.cond(x != 0, lambda: sines(x), lambda: jnp.zeros(()))

    written = [fused.scalarize(f, jnp.ones(()), branch_cost=3) for f in (skipping, choosing)]
    assert [x.operations["select_n"] for x in written] == [0, 1]
    results = [jax.jit(fused.vmap(f, branch_cost=3))(X) for f in (skipping, choosing)]
    np.testing.assert_array_equal(*results)


def test_results_must_be_of_the_structure_of_what_is_skipped_to():
    with pytest.raises((TypeError, ValueError)):
        fused.skippable(jnp.array(True), lambda: (X, X), X)


def test_its_size_is_that_of_the_computation():
    traced = jaxprs.trace(plus_sine, jnp.ones(()))[0]
    alone = jaxprs.trace(lambda x: x + jnp.sin(x), jnp.ones(()))[0]
    assert size.num_scalars(traced) == size.num_scalars(alone) + 1  # and the comparison
