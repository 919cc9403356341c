"""Branches: each lane has its own, and what no lane needs is not run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import (
    BRANCHES,
    assert_same,
    batch_of,
    heavy,
    primitives,
)

from mjx_reinforce import fused


@pytest.mark.parametrize("fn", BRANCHES)
def test_branches(fn):
    assert_same(fn, batch_of(), rtol=1e-5)


def conds(function, cost):
    """How many branches of a function may be skipped."""
    jaxpr = jax.make_jaxpr(fused.vmap(function, branch_cost=cost))(batch_of()).jaxpr
    return list(primitives(jaxpr)).count("cond")


def long(x):
    return jnp.sin(jnp.cos(jnp.exp(x)))


@pytest.mark.parametrize(("cost", "count"), [(3, 0), (2, 1)])
@pytest.mark.parametrize("order", [(long, jnp.abs), (jnp.abs, long)])
def test_a_branch_is_skipped_where_it_costs_more(cost, count, order):
    function = lambda x: lax.cond(x > 0, *order, x)  # noqa: E731
    assert conds(function, cost) == count
    np.testing.assert_allclose(
        fused.vmap(function, branch_cost=cost)(batch_of()), jax.vmap(function)(batch_of()), 1e-5
    )


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
