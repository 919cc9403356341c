"""What a loop does to its carry, read from its equations."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax

from mjx_reinforce.fused import carries, jaxprs, scalarize
from mjx_reinforce.fused.rules import iterate

X = jnp.ones(3)


def scanned(a, b):
    return lax.scan(lambda c, _: ((c[0], c[1] + c[0]), None), (a, b), length=3)[0]


KEPT = {
    "itself": lambda a, b: (a, b + 1),
    "jit": jax.jit(lambda a, b: (a, b + 1)),
    "checkpoint": jax.checkpoint(lambda a, b: (a, b * a)),
    "scan": scanned,
    "while": lambda a, b: lax.while_loop(lambda c: c[1][0] < 9, lambda c: (c[0], c[1] + 1), (a, b)),
    "cond": lambda a, b: lax.cond(b[0] > 0, lambda: (a, b), lambda: (a, b + 1)),
}
CHANGED = {
    "exchanged": lambda a, b: (b, a),
    "exchanged in a branch": lambda a, b: lax.cond(a[0] > 0, lambda: (a, b), lambda: (b, a)),
    "computed": lambda a, b: (jnp.zeros(3), b + 0),
}


def test_what_is_handed_on_through_calls_is_kept():
    steps = KEPT | CHANGED
    kept = {name: carries.keeps(jaxprs.trace(f, X, X)[0], 0, 2) for name, f in steps.items()}
    assert kept == {name: [name in KEPT, False] for name in steps}


def test_the_carry_may_begin_behind_constants():
    program, _ = jaxprs.trace(lambda const, a, b: (a + const, b), X, X, X)
    assert carries.keeps(program, 1, 2) == [False, True]


def test_lanes_differ_where_something_that_differs_arrives_in_the_end():
    def step(varying):
        a, b, c, d = varying
        return [a, a or b, b or c, d]

    assert carries.spread(step, [True, False, False, False]) == [True, True, True, False]


def test_loops_are_found_in_calls_too():
    for function, expected in (
        (lambda x: x + 1, False),
        (lambda x: lax.fori_loop(0, 9, lambda _, y: y + 1, x), True),
        (jax.jit(lambda x: lax.while_loop(lambda y: y[0] < 9, lambda y: y + 1, x)), True),
        (lambda x: lax.cond(x[0] > 0, lambda: lax.cumsum(x), lambda: x), False),
    ):
        assert carries.has_loops(jaxprs.trace(function, X)[0]) is expected


@pytest.mark.parametrize("outer", ["scan", "while"])
def test_a_body_with_a_loop_is_written_once(outer, monkeypatch):
    """And what all lanes share stays shared."""
    written = []
    original = iterate._trace_body

    def count(graph, plan, fixed, varying):
        written.append(plan)
        return original(graph, plan, fixed, varying)

    monkeypatch.setattr(iterate, "_trace_body", count)

    def body(state):
        number, x = state
        return number + 1, lax.fori_loop(0, 50, lambda _, y: y * 0.5 + number, x) + x

    def function(x):
        start = jnp.int32(0), x
        if outer == "scan":
            return lax.scan(lambda state, _: (body(state), None), start, length=40)[0]
        return lax.while_loop(lambda state: state[0] < 40, body, start)

    ((number,), (x,)) = scalarize(function, jnp.float32(3)).outputs
    loop = x.owner
    assert [loop.outs[-2], loop.outs[-1]] == [number, x]
    assert [number.varying, x.varying] == [False, True]
    assert sum(plan.inits == loop.inits for plan in written) == 1
