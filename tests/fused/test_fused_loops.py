"""Loops: they compute what JAX's do, and end when no lane goes on."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax
from mapped import (
    assert_same,
    batch_of,
    collatz,
    count,
    line_search,
    primitives,
)

from mjx_reinforce import fused
from mjx_reinforce.fused import scalarized
from mjx_reinforce.fused.graph import Limits

LOOPS = [
    lambda x: lax.fori_loop(0, 20, lambda i, y: 0.9 * y + i, x),
    lambda x: lax.fori_loop(0, (10 * x).astype(jnp.int32), lambda i, y: y + i, x),
    lambda x: collatz(1 + (20 * x).astype(jnp.int32)),
    line_search,
    lambda x: lax.scan(lambda c, y: (c * y, c + y), x, jnp.arange(1.0, 4.0)),
    lambda x: lax.scan(lambda c, y: (0.5 * c + y, c + y), x, x * jnp.arange(12.0)),
    lambda x: lax.scan(lambda c, y: (c - y, (c, 3.0)), x, jnp.arange(9.0), reverse=True),
    lambda x: lax.scan(lambda c, _: (c, c), x, None, length=0),
    lambda x: lax.map(lambda y: y * x, jnp.arange(7.0)),
    lambda x: lax.while_loop(lambda y: y > 10, lambda y: y + 1, jnp.abs(x)),
    lambda x: lax.fori_loop(
        0, 6, lambda i, y: lax.while_loop(lambda z: z < y[0], lambda z: z + x, 0.0) + y * 0.9,
        jnp.array([x, 1.0]),
    ),
]  # fmt: skip


@pytest.mark.parametrize("fn", LOOPS)
def test_loops(fn):
    assert_same(fn, batch_of(low=0.3, high=3), rtol=1e-5)


def test_line_search_becomes_a_loop_that_ends():
    written = fused.scalarize(line_search, jnp.ones(()))
    assert sum(written.operations.values()) < 25
    jaxpr = jax.make_jaxpr(fused.vmap(line_search))(jnp.ones(4)).jaxpr
    names = list(primitives(jaxpr))
    assert "while" in names
    assert "scan" not in names
    assert "cond" not in names


def test_a_switch_that_does_not_freeze_everything_is_not_taken_for_one():
    def fn(x):
        def body(carry, _):
            y, active = carry
            return (y + 1, active & (y < 3)), None  # y goes on when active is False

        return lax.scan(body, (x, jnp.array(True)), None, length=20)[0]

    assert_same(fn, batch_of())


def test_unused_results_are_not_computed():
    def fn(x):
        state = (x, jnp.sin(x), x)
        body = lambda i, s: (s[0] * 0.5, jnp.exp(s[1]), s[2])  # noqa: E731
        return lax.fori_loop(0, 40, body, state)[0]

    assert count(fn, 1.0) == 1


def test_short_loops_can_stay_loops():
    step = lambda _, x: jnp.sin(x) + x  # noqa: E731
    counts = [
        scalarized.build(
            lambda x: lax.fori_loop(0, 3, step, x), (jnp.ones(()),), [True], 400, Limits(plain)
        ).operations["sin"]
        for plain in (4, 1)
    ]
    assert counts == [3, 1]


def test_a_loop_that_never_runs_is_not_written():
    never = lambda x: lax.while_loop(lambda y: False, jnp.sin, x)  # noqa: E731
    assert count(never, 1.0) == 0
    assert_same(never, batch_of())


def test_a_lane_that_is_done_keeps_its_values():
    assert_same(lambda x: lax.while_loop(lambda y: y < x, lambda y: y + 1, 0.0), batch_of(high=9))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("length", [3, 9])
def test_what_a_scan_reads_and_keeps_is_in_order(length, reverse):
    """Written out and as a loop."""

    def function(x):
        rows = jnp.arange(1.0, length + 1) * x
        return lax.scan(lambda c, y: (c / 2 + y, (c, y)), x, rows, reverse=reverse)

    assert_same(function, batch_of())


@pytest.mark.parametrize(("limits", "counts"), [((3, 1), [3, 1]), ((1, 3), [1, 3])])
def test_the_limit_of_scans_with_arrays_is_another(limits, counts):
    def plain(x):
        return lax.fori_loop(0, 3, lambda _, y: jnp.sin(y), x)

    def reading(x):
        return lax.scan(lambda c, y: (jnp.sin(c) + y, None), x, x * jnp.arange(3.0))[0]

    written = [
        scalarized.build(function, (1.0,), [True], 400, Limits(*limits))
        for function in (plain, reading)
    ]
    assert [program.operations["sin"] for program in written] == counts
