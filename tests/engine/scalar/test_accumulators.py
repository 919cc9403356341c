"""Carries that need no copy: those the body does not read, and those that a branch adds to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce.engine.llvm.emit import LLVM
from mjx_reinforce.engine.play import program
from mjx_reinforce.engine.play.program import machine_map
from mjx_reinforce.engine.scalar import scalarized, skippable
from mjx_reinforce.engine.scalar.passes.liveness import LiveLoop, accumulators, unread

pytestmark = pytest.mark.cpu
#: Entries of a matrix, more than stay in registers.
SIZE = 6
ROWS = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4, SIZE)), jnp.float32)


def added_up(weights, between=lambda total, _: total):
    """Adds to a matrix for each weight that is positive; ``between`` changes it in each round."""

    def add(total, row):
        weight, vector = row

        def compute():
            grown = total
            for k in range(1, 4):
                grown = grown + jnp.sin(weight * k) * jnp.outer(vector, vector)
            return grown

        return between(skippable(weight > 0, compute, total), weight), None

    # A skippable sum: sin(0) is 0.
    return lax.scan(add, jnp.ones((SIZE, SIZE)), (jnp.maximum(weights, 0), ROWS[0]))[0]


def twice(weights):
    """What the first loop adds up goes on in the second, which alone reads it."""
    first = added_up(weights)

    def add(total, row):
        weight, vector = row
        compute = lambda: total + jnp.sin(weight * jnp.outer(vector, vector))  # noqa: E731
        return skippable(weight > 0, compute, total), None

    return lax.scan(add, first, (jnp.maximum(weights, 0), ROWS[1]))[0]


def start_read_again(weights):
    """The start of the second loop is read after it too: it must not be changed in place."""
    first = added_up(weights)
    second = lax.scan(
        lambda total, w: (skippable(w > 0, lambda: total + jnp.sin(w * first), total), None),
        first,
        jnp.maximum(weights, 0),
    )[0]
    return second - first


def begun_again(weights):
    """The second loop starts from the first one's sums again in each round of an outer loop."""
    first = added_up(weights)

    def turn(carry, _):
        def add(total, row):
            weight, vector = row
            compute = lambda: total + jnp.sin(weight * (jnp.outer(vector, vector) + carry[0, 0]))  # noqa: E731
            return skippable(weight > 0, compute, total), None

        rows = jnp.maximum(weights, 0), ROWS[2]
        return 0.1 * carry + lax.scan(add, first, rows)[0], None

    return lax.scan(turn, jnp.zeros((SIZE, SIZE)), None, length=4)[0]


def never_read(weights):
    """The angle goes on from round to round; its cosine and the last weight are read afterwards."""

    def turn(carry, weight):
        angle, _, _, count = carry
        inner = lax.scan(lambda c, x: (c + x, c * x), angle, weights)[1]
        return (angle + weight, jnp.cos(angle), inner, count + 1), None

    start = weights[0], jnp.float32(7), jnp.zeros(4), jnp.int32(0)
    return lax.scan(turn, start, weights)[0]


def ends_early(weights):
    """A loop that may not run at all: what its body does not read has its start then."""
    return lax.while_loop(
        lambda carry: carry[0] > 1, lambda carry: (carry[0] * 0.5, carry[0]), (weights[0], 9.0)
    )


def loops_of(function):
    """Loops in the order of their ends, from the innermost on."""
    example = jnp.ones(4)
    written = scalarized.build(function, (example,), [True], 100, program.LOOPS)

    def within(body):
        for step in body:
            if hasattr(step, "body"):
                yield from within(step.body)
            if isinstance(step, LiveLoop):
                yield step

    return list(within(written.schedule))


FUNCTIONS = [added_up, twice, start_read_again, begun_again, never_read, ends_early]


@pytest.mark.slow
@pytest.mark.parametrize("few", [True, False], ids=["in registers", "in place"])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_machine_code_gives_the_results_of_vmap(function, few, monkeypatch):
    """Of lanes that need all sums, some and none."""
    monkeypatch.setattr(LLVM, "MANY", 1_000 if few else 1)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(37, 4)), jnp.float32)
    weights = weights.at[0].set(-1).at[1].set(1)
    # Machine code is kept by the function that it is of: each of the two has its own.
    own = (lambda x: function(x + 0.0)) if few else (lambda x: function(x - 0.0))
    got = jax.jit(machine_map(own, weights[0]))(weights)
    want = jax.vmap(function)(weights)
    for x, exact in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, exact, rtol=2e-5, atol=2e-5)


def test_sums_of_a_branch_change_in_place():
    (loop,) = loops_of(added_up)
    changed = {id(carry.leaf) for carry in accumulators(loop).values()}
    assert changed == {id(carry.leaf) for carry in loop.carries}
    assert len(changed) == SIZE**2


@pytest.mark.parametrize(
    "between",
    [
        lambda total, weight: total * 2,
        lambda total, weight: total.at[0, 0].add(weight),
        lambda total, weight: total.T[::-1],
    ],
    ids=["the sum is read", "one is read", "they change places"],
)
def test_what_is_read_elsewhere_does_not(between):
    (loop,) = loops_of(lambda weights: added_up(weights, between))
    changed = {id(carry.leaf) for carry in accumulators(loop).values()}
    for carry in loop.carries:
        others = [id(other.next) for other in loop.carries if other is not carry]
        assert id(carry.leaf) not in changed or id(carry.leaf) not in others
    assert len(changed) < len(loop.carries)


def test_what_is_selected_does_not():
    def add(total, weight):
        return lax.cond(weight > 0, lambda: total + jnp.sin(weight * ROWS[0]), lambda: total), None

    (loop,) = loops_of(lambda weights: lax.scan(add, jnp.ones((4, SIZE)), weights)[0])
    assert loop.carries
    assert not accumulators(loop)


def test_carries_that_the_body_does_not_read():
    """A cosine, four records of the inner loop; the angle and what is counted are read."""
    outer = loops_of(never_read)[-1]
    assert len(unread(outer)) == 5
    assert len(outer.carries) == 7
    starts = {carry.leaf: carry.init for carry in outer.carries}
    assert all(starts[leaf] == 0 for leaf in unread(outer))  # nothing reads them


def test_a_loop_that_may_not_run_has_its_starts():
    (loop,) = loops_of(ends_early)
    assert sorted(float(c.init) for c in loop.carries if not hasattr(c.init, "op")) == [9.0]
