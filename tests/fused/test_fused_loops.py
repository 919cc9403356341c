"""Loops: they compute what JAX's do, and end when no lane goes on."""

import itertools

import jax.numpy as jnp
from jax import lax
from mapped import assert_same, batch_of, collatz, count, line_search, primitives

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
    lambda x: lax.while_loop(lambda y: y < 3 * x, lambda y: y + 1, 0.0),
    lambda x: lax.while_loop(lambda y: y > 10, lambda y: y + 1, jnp.abs(x)),
    lambda x: lax.fori_loop(
        0, 6, lambda i, y: lax.while_loop(lambda z: z < y[0], lambda z: z + x, 0.0) + y * 0.9,
        jnp.array([x, 1.0]),
    ),
]  # fmt: skip


def test_loops():
    loops = lambda x: [fn(x) for fn in LOOPS]  # noqa: E731
    assert_same(loops, batch_of(low=0.3, high=3), rtol=1e-5)


def test_line_search_becomes_a_loop_that_ends():
    written = fused.scalarize(line_search, jnp.ones(()))
    assert sum(written.operations.values()) < 25
    names = {"while", "scan", "cond"} & {*primitives(fused.vmap(line_search), jnp.ones(4))}
    assert names == {"while"}


def test_a_switch_that_does_not_freeze_everything_is_not_taken_for_one():
    def fn(x):
        def body(carry, _):
            y, active = carry
            return (y + 1, active & (y < 3)), None  # y goes on when active is False

        return lax.scan(body, (x, jnp.array(True)), None, length=20)[0]

    assert_same(fn, batch_of())


def test_a_loop_that_never_runs_is_not_written():
    never = lambda x: lax.while_loop(lambda y: False, jnp.sin, x)  # noqa: E731
    assert count(never, 1.0) == 0
    assert_same(never, batch_of())


def test_what_a_scan_reads_and_keeps_is_in_order():
    """Written out and as a loop."""

    def scan(x, length, reverse):
        rows = jnp.arange(1.0, length + 1) * x
        return lax.scan(lambda c, y: (c / 2 + y, (c, y)), x, rows, reverse=reverse)

    cases = [*itertools.product((3, 9), (False, True))]
    assert_same(lambda x: [scan(x, *case) for case in cases], batch_of())


def test_short_loops_are_written_out_and_the_limit_of_scans_with_arrays_is_another():
    def plain(x):
        return lax.fori_loop(0, 3, lambda _, y: jnp.sin(y), x)

    def reading(x):
        return lax.scan(lambda c, y: (jnp.sin(c) + y, None), x, x * jnp.arange(3.0))[0]

    def sines(function, *limits):
        return scalarized.build(function, (1.0,), [True], 400, Limits(*limits)).operations["sin"]

    assert [sines(plain, 3, 1), sines(reading, 3, 1)] == [3, 1]
    assert [sines(plain, 1, 3), sines(reading, 1, 3)] == [1, 3]
