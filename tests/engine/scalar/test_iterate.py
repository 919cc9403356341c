"""The carry of a loop: what changes, what differs from lane to lane, what is foreseen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce.engine.scalar import jaxprs, scalarize
from mjx_reinforce.engine.scalar.graph import Graph, Limits
from mjx_reinforce.engine.scalar.rules import iterate

ONE = np.float32(1)


@pytest.fixture
def graph():
    return Graph(0, Limits())


def build(graph, step, inits, **options):
    return iterate.iterate(graph, lambda state, row: (step(*state, *row), []), inits, **options)


def test_what_never_changes_is_not_carried(graph):
    """Also where that shows only after another was found to change."""
    x = graph.leaf(np.float32, True)

    def step(a, b, c):
        return [a, graph.call("add", b, a), graph.call("mul", c, ONE)]

    loop = build(graph, step, [x, x, ONE], length=9)
    assert [carry is None for carry in loop.carries] == [True, False, True]
    assert loop.results()[0][0] is x
    assert loop.results()[0][2] == ONE


def test_a_change_is_handed_on_from_carry_to_carry(graph):
    loop = build(graph, lambda a, b, c: [graph.call("neg", c), a, b], [ONE] * 3, length=9)
    assert None not in loop.carries


def test_lanes_differ_as_soon_as_what_is_added_does(graph):
    """The first carry is shared at first, and differs once the second one has been added."""
    x, shared = graph.leaf(np.float32, True), graph.leaf(np.float32, False)
    for reads_other in (False, True):

        def step(a, b, reads_other=reads_other):
            added = b if reads_other else shared
            return [graph.call("add", a, added), graph.call("mul", b, x)]

        loop = build(graph, step, [ONE, ONE], length=9)
        assert [iterate.varies(out) for out in loop.outs] == [reads_other, True]


def test_an_element_that_is_the_same_throughout_is_not_read(graph):
    x = graph.leaf(np.float32, True)
    loop = build(
        graph, lambda a, y, z: [graph.call("add", a, z)], [ONE], length=2, xs=[[x, x], [x, ONE]]
    )
    assert [element is None for element in loop.elements] == [True, False]


def test_what_depends_on_nothing_inside_is_computed_before(graph):
    x = graph.leaf(np.float32, True)
    step = lambda a: [graph.call("add", a, graph.call("sin", x))]  # noqa: E731
    loop = build(graph, step, [ONE], length=9)
    sine = next(arg for arg in loop.nexts[0].args if arg.op is not None)
    assert sine.scope is graph.scope
    assert loop.nexts[0].scope is loop.body


def test_inside_of_a_loop_some_lane_goes_on(graph):
    """So a branch on the loop's own predicate needs no test."""
    x = graph.leaf(np.float32, True)
    known = []

    def step(active, a):
        known.append(active in graph.certain)
        return [graph.call("lt", a, x), graph.call("add", a, ONE)]

    build(graph, step, [graph.call("lt", ONE, x), ONE], active=0)
    assert known[-1]
    assert not graph.certain


ROW = jnp.ones(3)


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
    kept = {name: iterate.keeps(jaxprs.trace(f, ROW, ROW)[0], 0, 2) for name, f in steps.items()}
    assert kept == {name: [name in KEPT, False] for name in steps}


def test_the_carry_may_begin_behind_constants():
    program, _ = jaxprs.trace(lambda const, a, b: (a + const, b), ROW, ROW, ROW)
    assert iterate.keeps(program, 1, 2) == [False, True]


def test_lanes_differ_where_something_that_differs_arrives_in_the_end():
    def step(varying):
        a, b, c, d = varying
        return [a, a or b, b or c, d]

    assert iterate.spread(step, [True, False, False, False]) == [True, True, True, False]


def test_loops_are_found_in_calls_too():
    for function, expected in (
        (lambda x: x + 1, False),
        (lambda x: lax.fori_loop(0, 9, lambda _, y: y + 1, x), True),
        (jax.jit(lambda x: lax.while_loop(lambda y: y[0] < 9, lambda y: y + 1, x)), True),
        (lambda x: lax.cond(x[0] > 0, lambda: lax.cumsum(x), lambda: x), False),
    ):
        assert iterate.has_loops(jaxprs.trace(function, ROW)[0]) is expected


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
