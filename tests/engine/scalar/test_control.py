"""Loops and branches: what JAX computes, ended or skipped where no lane needs more."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_same, batch_of, collatz, count, heavy, line_search, primitives

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import jaxprs, scalarized, size
from mjx_reinforce.engine.scalar.nodes import Node
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop

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
    written = scalar.scalarize(line_search, jnp.ones(()))
    assert sum(written.operations.values()) < 25
    names = {"while", "scan", "cond"} & {*primitives(scalar.vmap(line_search), jnp.ones(4))}
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


def test_short_loops_are_written_out():
    plain = lambda x: lax.fori_loop(0, 3, lambda _, y: jnp.sin(y), x)  # noqa: E731
    reading = lambda x: lax.scan(lambda c, y: (jnp.sin(c) + y, None), x, x * jnp.arange(3.0))[0]  # noqa: E731
    for function in (plain, reading):
        written = (scalarized.build(*scalarized.trace(function, 1.0), 400, n) for n in (2, 3))
        assert [each.operations["sin"] for each in written] == [1, 3]


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
    mapped = jax.jit(scalar.vmap(fn))
    results = mapped(x), jax.jit(jax.vmap(fn))(x), mapped(x.at[2].set(jnp.nan))
    for ours, theirs, dirty in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=2e-6)
        np.testing.assert_array_equal(np.delete(dirty, 2), np.delete(ours, 2))


def conds(function, cost):
    """How many branches of a function may be skipped."""
    return primitives(scalar.vmap(function, branch_cost=cost), batch_of()).count("cond")


def long(x):
    return jnp.sin(jnp.cos(jnp.exp(x)))


def test_a_branch_is_skipped_where_it_costs_more():
    for order in ((long, jnp.abs), (jnp.abs, long)):
        function = lambda x, order=order: lax.cond(x > 0, *order, x)  # noqa: E731
        assert [conds(function, cost) for cost in (3, 2)] == [0, 1]
        for cost in (3, 2):
            got = scalar.vmap(function, branch_cost=cost)(batch_of())
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
    assert scalar.scalarize(lambda x: lax.cond(True, jnp.sin, long, x), 1.0).operations == {
        "sin": 1
    }
    function = lambda x: lax.switch(7, [jnp.sin, jnp.cos, jnp.tan], x)  # noqa: E731
    assert scalar.scalarize(function, 1.0).operations == {"tan": 1}


def test_results_that_the_branches_share_are_not_chosen():
    function = lambda x: lax.cond(x > 0, lambda: (x, long(x)), lambda: (x, x))  # noqa: E731
    counted = scalar.scalarize(function, 1.0, branch_cost=2).operations
    assert counted["select_n"] == 1


def schedule(function, *examples, cost=1):
    return scalar.scalarize(function, *examples, branch_cost=cost).schedule


def names(steps):
    return [step.op.name for step in steps if isinstance(step, Node)]


def only(kind, steps):
    (found,) = [step for step in steps if isinstance(step, kind)]
    return found


def test_a_loop_carries_what_its_results_need():
    """The second carry reads the first."""
    for which, carried in ((0, 1), (1, 2), (2, 1)):

        def function(x, which=which):
            step = lambda _, s: (s[0] * x, s[1] + s[0], jnp.sin(s[2]))  # noqa: E731
            return lax.fori_loop(0, 9, step, (x, x, x))[which]

        loop = only(LiveLoop, schedule(function, 1.0))
        assert len(loop.carries) == carried
        assert ("sin" in names(loop.body)) == (which == 2)


def test_what_ends_a_loop_is_carried():
    def function(x):
        return lax.while_loop(lambda s: s[1] < x, lambda s: (s[0] * x, s[1] + 1), (x, 0.0))[0]

    loop = only(LiveLoop, schedule(function, 1.0))
    assert loop.carries[loop.active].leaf.dtype == bool
    assert len(loop.carries) == 3


def test_a_gate_computes_what_its_results_need():
    def function(x):
        long = lambda y: (jnp.sin(jnp.cos(y)), jnp.exp(jnp.tan(y)))  # noqa: E731
        return lax.cond(x > 0, long, lambda y: (y, y), x)[0]

    gate = only(LiveGate, schedule(function, 1.0))
    assert len(gate.outs) == 1
    assert names(gate.body) == ["cos", "sin", "select_n"]


# -------------------------------------------------------------------------------------------------
# What a function says to be written out as: which way it takes, and what may be skipped.


def choice(x):
    """Tells whether it is written out."""
    return x + 1 if scalar.is_written_out() else 2 * x


X = jnp.arange(3.0)


def test_a_function_knows_whether_it_is_written_out():
    """Also what JAX has traced before for the other."""
    kept = jax.jit(choice)
    for function in (
        choice,
        kept,
        lambda x: lax.cond(x < 9, choice, jnp.sin, x),
        jax.checkpoint(choice),
        scalar.prune(lambda x: (kept(x), jnp.cos(x))[0]),
    ):
        for _ in range(2):
            np.testing.assert_array_equal(jax.vmap(function)(X), 2 * X)
            np.testing.assert_array_equal(scalar.vmap(function)(X), X + 1)
    assert scalar.scalarize(kept, X).operations == {"add": 3}
    assert size.num_scalars(scalarized.trace(kept, X)[0]) == 3


def total(x, scan=lax.scan, **options):
    step = lambda carry, row: (carry + jnp.sin(row), None)  # noqa: E731
    return scan(step, 0.0, x, **options)[0]


def sines(fn, unrolled, length=7):
    traced = scalarized.trace(fn, jnp.ones(length), unrolled=unrolled)
    return scalarized.build(*traced, 400, 1).operations["sin"]


def test_short_scans_are_written_out():
    for scan, unrolled, expected in (
        (lax.scan, 7, 1),
        (scalar.short_scan, 6, 1),
        (scalar.short_scan, 7, 7),
    ):
        assert sines(functools.partial(total, scan=scan), unrolled) == expected
    np.testing.assert_allclose(total(X, scalar.short_scan), np.sin(X).sum(), rtol=1e-6)


def test_the_unroll_of_a_scan_means_what_it_means_to_jax():
    """Only a scan that JAX would write out whole is written out."""
    each = (1, 2, 6, 7, True)
    assert [sines(lambda x, n=n: total(x, unroll=n), 7) for n in each] == [1, 1, 1, 7, 7]


def test_what_may_be_skipped_has_its_derivative_where_it_is_written_out():
    def cube(x):
        return scalar.skippable(x != 0, lambda: x**3, 0 * x)

    x = jnp.array([-1.0, 0.0, 2.0])
    for mapped in (jax.vmap, scalar.vmap):
        np.testing.assert_allclose(mapped(jax.grad(cube))(x), 3 * x**2)


def test_platform_dependent_takes_its_default():
    """Documented: what is written out does not depend on where it will run."""

    def fn(x):
        return lax.platform_dependent(x, cpu=lambda x: x + 1, cuda=jnp.sin, default=lambda x: x + 2)

    np.testing.assert_array_equal(scalar.vmap(fn)(X), X + 2)


def test_platform_dependent_without_a_default_is_refused_by_name():
    def fn(x):
        return lax.platform_dependent(x, cpu=lambda x: x + 1, cuda=jnp.sin)

    with pytest.raises(scalar.UnsupportedPrimitive, match=r"without a default.*test_control\.py"):
        scalar.vmap(fn)(X)


def plus_sine(x):
    """Adds the sine, of which that of 0 changes nothing."""
    return scalar.skippable(x != 0, lambda: {"y": x + jnp.sin(x)}, {"y": x})["y"]


NUMBERS = jnp.array([0.0, 1.0, -2.0])


def test_results():
    """By JAX, and written out with a branch and without one; of one example too."""
    for transformed in (
        jax.vmap(plus_sine),
        jax.jit(jax.vmap(plus_sine)),
        scalar.vmap(plus_sine, branch_cost=0),
        scalar.vmap(plus_sine, branch_cost=10_000),
    ):
        np.testing.assert_allclose(transformed(NUMBERS), NUMBERS + jnp.sin(NUMBERS), rtol=1e-6)
    assert plus_sine(jnp.float32(2)) == 2 + jnp.sin(jnp.float32(2))
    assert jax.jit(plus_sine)(jnp.float32(0)) == 0


def test_where_it_is_known_whether_it_is_needed():
    for needed in (True, False):
        both = scalar.vmap(lambda x, n=needed: scalar.skippable(jnp.array(n), lambda: x * 2, x))
        np.testing.assert_array_equal(both(jnp.ones(3)), [1.0 + needed] * 3)


def test_results_must_be_of_the_structure_of_what_is_skipped_to():
    with pytest.raises((TypeError, ValueError)):
        scalar.skippable(jnp.array(True), lambda: (NUMBERS, NUMBERS), NUMBERS)


def test_its_size_is_that_of_the_computation():
    traced = scalarized.trace(plus_sine, jnp.ones(()))[0]
    alone = jaxprs.trace(lambda x: x + jnp.sin(x), jnp.ones(()))[0]
    assert size.num_scalars(traced) == size.num_scalars(alone) + 1  # and the comparison
