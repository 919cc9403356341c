"""What a function says to be written out as: the choice by engine, and what may be skipped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import jaxprs, primitives, scalarized, size
from mjx_reinforce.engine.scalar.graph import Limits


def choice(x, scale=1.0):
    """Tells which of the two was computed: x + 1 is `one`, 2 x is `many`."""
    return scalar.by_engine(lambda y: scale * (y + 1), lambda y: scale * (2 * y), x)


X = jnp.arange(3.0)


def test_xla_computes_many():
    for transformed in (
        choice,
        jax.jit(choice),
        jax.vmap(choice),
        jax.jit(jax.vmap(jax.vmap(choice, in_axes=0), in_axes=None, axis_size=1)),
        lambda x: jax.vmap(choice, in_axes=(0, None))(x, 1.0),
        jax.checkpoint(choice),
        lambda x: lax.map(choice, x),
        lambda x: lax.cond(x[0] < 9, choice, jnp.sin, x),
        scalar.prune(lambda x: (choice(x), jnp.sort(x))[0]),
    ):
        np.testing.assert_array_equal(np.squeeze(transformed(X)), 2 * X)


def test_one_is_written_out():
    for function in (
        choice,
        jax.jit(choice),
        lambda x: lax.cond(x < 9, choice, jnp.sin, x),
        jax.checkpoint(choice),
    ):
        np.testing.assert_array_equal(scalar.vmap(function)(X), X + 1)


def test_xla_does_not_read_what_is_written_out(monkeypatch):
    """To map it takes as long as to map what XLA compiles."""
    read = property(lambda _: pytest.fail("the program was read"))
    monkeypatch.setattr(primitives._Mapped, "_traced", read)
    twice = jax.jit(jax.vmap(jax.vmap(choice)))
    np.testing.assert_array_equal(twice(jnp.ones((2, 3))), 2 * jnp.ones((2, 3)))
    with pytest.raises(pytest.fail.Exception, match="was read"):
        scalar.vmap(jax.vmap(choice))(jnp.ones((2, 3)))
    monkeypatch.undo()
    x = jnp.ones((2, 3))
    np.testing.assert_array_equal(scalar.vmap(jax.vmap(choice))(x), x + 1)


def test_a_mapped_program_is_part_of_the_fingerprint():
    """Its constants too, and those of programs in it."""

    def mapped(offset):
        offset = np.full(3, offset, np.float32)
        return jax.vmap(lambda x: scalar.by_engine(lambda y: y + offset, lambda y: y, x))

    prints = [jaxprs.fingerprint(jaxprs.trace(mapped(k), jnp.ones((2, 3)))[0]) for k in (1, 1, 2)]
    assert prints[0] == prints[1] != prints[2]


def test_derivatives_are_those_of_many():
    """For all engines, forwards and in reverse, with respect to what is closed over too."""
    for mapped in (jax.vmap, scalar.vmap):
        np.testing.assert_array_equal(mapped(jax.grad(choice))(X), [2.0, 2.0, 2.0])
        np.testing.assert_array_equal(mapped(jax.grad(choice, 1), (0, None))(X, 1.0), 2 * X)
        np.testing.assert_array_equal(mapped(jax.jacfwd(choice))(X), [2.0, 2.0, 2.0])


def test_derivatives_pass_integers_by():
    pick = lambda x, i: scalar.by_engine(lambda x, i: x[i], lambda x, i: x[i] * 2, x, i)  # noqa: E731
    np.testing.assert_array_equal(jax.grad(pick)(X, 1), [0.0, 2.0, 0.0])


def test_a_result_of_nothing_mapped_stays_one():
    """As of `lax.cond`: what XLA computes for all lanes together is not computed for each."""

    def fn(x, y):
        return scalar.by_engine(lambda x, y: (x, y + 1), lambda x, y: (x, y + 2), x, y)

    out = jax.jit(jax.vmap(fn, in_axes=(0, None), out_axes=(0, None)))(X, 1.0)
    assert out[1].shape == ()
    np.testing.assert_array_equal(out[1], 3.0)


def test_the_size_is_that_of_one():
    traced, _ = jaxprs.trace(
        lambda x: scalar.by_engine(lambda x: x + 1, lambda x: jnp.sin(jnp.cos(x)), x), X
    )
    assert size.num_scalars(traced) == 3


def test_what_is_not_traced_is_computed_at_once():
    """Without a look at ``one``; programs that have been traced are computed without it too."""
    scalar.by_engine(pytest.fail, lambda x: x, X)
    jaxpr = jax.make_jaxpr(choice)(X)
    assert "by_engine" in str(jaxpr)
    np.testing.assert_array_equal(jax.core.eval_jaxpr(jaxpr.jaxpr, jaxpr.consts, X)[0], 2 * X)


@pytest.mark.parametrize("other", [lambda x: (x,), lambda x: x[:1], lambda x: x > 0])
def test_results_that_differ_are_refused(other):
    with pytest.raises(TypeError, match="by_engine got two different results"):
        jax.jit(lambda x: scalar.by_engine(lambda x: x, other, x))(X)


def total(x, **options):
    step = lambda carry, row: (carry + jnp.sin(row), None)  # noqa: E731
    return lax.scan(step, 0.0, x, **options)[0]


def sines(fn, unrollable, length=7):
    limits = Limits(1, unrollable)
    return scalarized.build(fn, (jnp.ones(length),), [True], 400, limits).operations["sin"]


def chosen(may_unroll, inner=total):
    return lambda x: scalar.by_engine(inner, lambda x: x[0], x, may_unroll=may_unroll)


def test_scans_that_may_be_written_out_are_up_to_a_length():
    counts = [sines(chosen(may), most) for may, most in ((False, 7), (True, 6), (True, 7))]
    assert counts == [1, 1, 7]


def test_scans_inside_loops_are_not_what_may_be_written_out():
    def nested(x):
        return lax.fori_loop(0, 9, lambda _, y: y + total(x), 0.0)

    assert sines(chosen(True, nested), 7) == 1
    # Jitted functions are no loops, and what comes behind the mark is not marked.
    assert sines(lambda x: chosen(True, jax.jit(total))(x) + total(2 * x), 7) == 7 + 1


def test_the_unroll_of_a_scan_means_what_it_means_to_jax():
    """Only a scan that JAX would write out whole is written out."""
    each = (1, 2, 6, 7, True)
    assert [sines(lambda x, n=n: total(x, unroll=n), 7) for n in each] == [1, 1, 1, 7, 7]


def test_platform_dependent_takes_its_default():
    """Documented: what is written out does not depend on where it will run."""

    def fn(x):
        return lax.platform_dependent(x, cpu=lambda x: x + 1, cuda=jnp.sin, default=lambda x: x + 2)

    np.testing.assert_array_equal(scalar.vmap(fn)(X), X + 2)


def test_platform_dependent_without_a_default_is_refused_by_name():
    def fn(x):
        return lax.platform_dependent(x, cpu=lambda x: x + 1, cuda=jnp.sin)

    with pytest.raises(
        scalar.UnsupportedPrimitive, match=r"without a default.*test_primitives\.py"
    ):
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


def test_nothing_is_selected():
    """Of ``lax.cond`` each lane's own result is."""

    def sines(x):
        return sum(jnp.sin(x * k) for k in range(1, 9))

    def skipping(x):
        return scalar.skippable(x != 0, lambda: sines(x), jnp.zeros(()))

    def choosing(x):
        return jax.lax.cond(x != 0, lambda: sines(x), lambda: jnp.zeros(()))

    written = [scalar.scalarize(f, jnp.ones(()), branch_cost=3) for f in (skipping, choosing)]
    assert [x.operations["select_n"] for x in written] == [0, 1]
    results = [jax.jit(scalar.vmap(f, branch_cost=3))(NUMBERS) for f in (skipping, choosing)]
    np.testing.assert_array_equal(*results)


def test_results_must_be_of_the_structure_of_what_is_skipped_to():
    with pytest.raises((TypeError, ValueError)):
        scalar.skippable(jnp.array(True), lambda: (NUMBERS, NUMBERS), NUMBERS)


def test_its_size_is_that_of_the_computation():
    traced = jaxprs.trace(plus_sine, jnp.ones(()))[0]
    alone = jaxprs.trace(lambda x: x + jnp.sin(x), jnp.ones(()))[0]
    assert size.num_scalars(traced) == size.num_scalars(alone) + 1  # and the comparison
