"""Branches: each lane has its own, and what no lane needs is not run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_same, batch_of, heavy, line_search, primitives

from mjx_reinforce import fused

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


def repeated(x):
    return lax.fori_loop(0, 20, lambda i, y: 0.9 * y + i, x)


@pytest.mark.parametrize("fn", [*BRANCHES, repeated, line_search])
def test_branches_are_those_of_jax_and_a_nan_stays_in_its_lane(fn):
    x = batch_of(low=0.3 if fn is line_search else -2)
    mapped = jax.jit(fused.vmap(fn))
    results = mapped(x), jax.jit(jax.vmap(fn))(x), mapped(x.at[2].set(jnp.nan))
    for ours, theirs, dirty in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=2e-6)
        np.testing.assert_array_equal(np.delete(dirty, 2), np.delete(ours, 2))


def conds(function, cost):
    """How many branches of a function may be skipped."""
    return primitives(fused.vmap(function, branch_cost=cost), batch_of()).count("cond")


def long(x):
    return jnp.sin(jnp.cos(jnp.exp(x)))


def test_a_branch_is_skipped_where_it_costs_more():
    for order in ((long, jnp.abs), (jnp.abs, long)):
        function = lambda x, order=order: lax.cond(x > 0, *order, x)  # noqa: E731
        assert [conds(function, cost) for cost in (3, 2)] == [0, 1]
        for cost in (3, 2):
            got = fused.vmap(function, branch_cost=cost)(batch_of())
            np.testing.assert_allclose(got, jax.vmap(function)(batch_of()), 1e-5)


def test_a_branch_with_a_loop_is_skipped_whatever_it_costs():
    assert conds(lambda x: lax.cond(x > 0, heavy, jnp.abs, x), 10_000) == 1


def test_a_predicate_that_is_known_to_hold_somewhere_is_not_asked_again():
    def function(x):
        positive = x > 0
        return lax.cond(positive, lambda: long(x) + lax.cond(positive, heavy, long, -x), lambda: x)

    assert conds(function, 2) == 2  # the outer one, and the inner one's other side
    assert_same(function, batch_of(), rtol=1e-5)


def test_a_branch_that_no_lane_can_take_is_not_written():
    assert fused.scalarize(lambda x: lax.cond(True, jnp.sin, long, x), 1.0).operations == {"sin": 1}
    function = lambda x: lax.switch(7, [jnp.sin, jnp.cos, jnp.tan], x)  # noqa: E731
    assert fused.scalarize(function, 1.0).operations == {"tan": 1}


def test_results_that_the_branches_share_are_not_chosen():
    function = lambda x: lax.cond(x > 0, lambda: (x, long(x)), lambda: (x, x))  # noqa: E731
    counted = fused.scalarize(function, 1.0, branch_cost=2).operations
    assert counted["select_n"] == 1
