"""The carry of a loop of the graph: what changes, and what differs from lane to lane."""

import numpy as np
import pytest

from mjx_reinforce.fused.graph import Graph, Limits
from mjx_reinforce.fused.rules.iterate import iterate, varies

ONE = np.float32(1)


@pytest.fixture
def graph():
    return Graph(0, Limits())


def build(graph, step, inits, **options):
    return iterate(graph, lambda state, row: (step(*state, *row), []), inits, **options)


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
        assert [varies(out) for out in loop.outs] == [reads_other, True]


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
