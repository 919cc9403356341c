"""What is written out is well formed, and a program that is not is found out."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from verify import verify

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.nodes import Node
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop


def program(x):
    """Has a loop that keeps records, one that ends, and a branch that some lanes do not need."""
    total, kept = lax.scan(lambda c, y: (c * y + 1, c - y), x[0], jnp.arange(9.0) * x[1])
    count = lax.while_loop(lambda y: y < 30, lambda y: y + x[1], total)
    gated = lax.cond(x[0] > 0, lambda y: jnp.sin(y) * jnp.exp(y), jnp.cos, count)
    return gated + kept.sum(), (x > 1).astype(jnp.int32)


def first(written, kind):
    """The first loop, gate or addition of a program."""
    found = (x for x in written.schedule if isinstance(x, kind))
    return next(x for x in found if kind is not Node or x.op.name == "add")


def put(array, place, value):
    array[place] = value


def replace(written, kind, **parts):
    step = first(written, kind)
    put(written.schedule, written.schedule.index(step), dataclasses.replace(step, **parts))


def change_carry(written):
    carries = first(written, LiveLoop).carries
    carries[0] = carries[0]._replace(next=np.int32(0))


def change_operands(written, *operands):
    node = first(written, Node)
    node.args = (node.args[0], *operands)


ONE = np.float32(1)
#: name -> (what breaks a program, what is said of it)
FAULTS = {
    "wrong dtype": (
        lambda x: change_operands(x, np.int32(1)),
        r"add \(\d+\) takes .*float32.*int32.* to float32",
    ),
    "wrong arity": (change_operands, r"add \(\d+\) takes"),
    "used before": (lambda x: x.schedule.reverse(), "is read where it is not known"),
    "lost": (
        lambda x: x.schedule.remove(first(x, LiveLoop)),
        r"a leaf \(\d+\) is read where it is not known",
    ),
    "out of scope": (
        lambda x: put(x.outputs[0], 0, first(x, LiveGate).body[-1]),
        "is read where it is not known",
    ),
    "changed carry": (change_carry, r"a carry is float32 and also .*int32"),
    "shared carry": (
        lambda x: setattr(first(x, LiveLoop).carries[0].leaf, "varying", False),
        "varies otherwise|does not vary",
    ),
    "endless": (lambda x: replace(x, LiveLoop, length=None, active=None), "a loop never ends"),
    "lost record": (
        lambda x: first(x, LiveLoop).records[0].outs.pop(),
        "a loop keeps too few records",
    ),
    "no predicate": (
        lambda x: replace(x, LiveGate, predicate=first(x, LiveGate).outs[0].cold),
        "a gate's predicate is no bool",
    ),
    "in vain": (lambda x: put(x.outputs[0], 0, ONE), "is computed and never read"),
    "wrong result": (lambda x: put(x.outputs[1], 0, ONE), r"a result is int32 and also .*float32"),
    "too few results": (lambda x: x.outputs[1].pop(), "a result has too few scalars"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found(name):
    fault, message = FAULTS[name]
    written = scalar.scalarize(program, jnp.ones(2), branch_cost=1)
    verify(written)
    fault(written)
    with pytest.raises(AssertionError, match=message):
        verify(written)


def test_the_tests_verify_all_that_is_written_out(monkeypatch):
    assert scalarized.inspect is verify
    seen = []
    monkeypatch.setattr(scalarized, "inspect", seen.append)
    written = scalar.scalarize(jnp.sin, 1.0)
    assert seen == [written]
