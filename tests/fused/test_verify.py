"""What is written out is well formed, and a program that is not is found out."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce import fused
from mjx_reinforce.fused import scalarized
from mjx_reinforce.fused.passes.liveness import LiveGate, LiveLoop
from mjx_reinforce.fused.passes.verify import verify


def program(x):
    """Has a loop that keeps records, one that ends, and a branch that some lanes do not need."""
    total, kept = lax.scan(lambda c, y: (c * y + 1, c - y), x[0], jnp.arange(9.0) * x[1])
    count = lax.while_loop(lambda y: y < 30, lambda y: y + x[1], total)
    gated = lax.cond(x[0] > 0, lambda y: jnp.sin(y) * jnp.exp(y), jnp.cos, count)
    return gated + kept.sum(), (x > 1).astype(jnp.int32)


def steps_of(written, kind):
    return next(step for step in written.schedule if isinstance(step, kind))


def wrong_dtype(written):
    node = next(x for x in written.schedule if getattr(x, "op", None) and x.op.name == "add")
    node.args = (node.args[0], np.int32(1))


def wrong_arity(written):
    node = next(x for x in written.schedule if getattr(x, "op", None) and x.op.name == "add")
    node.args = node.args[:1]


def use_before(written):
    written.schedule.reverse()


def lost(written):
    written.schedule.remove(steps_of(written, LiveLoop))


def out_of_scope(written):
    gate = steps_of(written, LiveGate)
    inner = gate.body[-1]
    written.outputs[0][0] = inner


def changed_carry(written):
    loop = steps_of(written, LiveLoop)
    loop.carries[0] = loop.carries[0]._replace(next=np.int32(0))


def shared_carry(written):
    carry = steps_of(written, LiveLoop).carries[0]
    carry.leaf.varying = False


def endless(written):
    loop = steps_of(written, LiveLoop)
    at = written.schedule.index(loop)
    written.schedule[at] = dataclasses.replace(loop, length=None, active=None)


def lost_record(written):
    steps_of(written, LiveLoop).records[0].outs.pop()


def no_predicate(written):
    gate = steps_of(written, LiveGate)
    at = written.schedule.index(gate)
    written.schedule[at] = dataclasses.replace(gate, predicate=gate.outs[0].cold)


def in_vain(written):
    written.outputs[0][0] = np.float32(1)


def wrong_result(written):
    written.outputs[1][0] = np.float32(1)


def too_few_results(written):
    written.outputs[1].pop()


FAULTS = {
    wrong_dtype: r"add \(\d+\) takes .*float32.*int32.* to float32",
    wrong_arity: r"add \(\d+\) takes",
    use_before: r"is read where it is not known",
    lost: r"a leaf \(\d+\) is read where it is not known",
    out_of_scope: r"is read where it is not known",
    changed_carry: r"a carry is float32 and also .*int32",
    shared_carry: r"varies otherwise|does not vary",
    endless: r"a loop never ends",
    lost_record: r"a loop keeps too few records",
    no_predicate: r"a gate's predicate is no bool",
    in_vain: r"is computed and never read",
    wrong_result: r"a result is int32 and also .*float32",
    too_few_results: r"a result has too few scalars",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found(fault):
    written = fused.scalarize(program, jnp.ones(2), branch_cost=1)
    verify(written)
    fault(written)
    with pytest.raises(AssertionError, match=FAULTS[fault]):
        verify(written)


def test_the_tests_verify_all_that_is_written_out(monkeypatch):
    assert scalarized.inspect is verify
    seen = []
    monkeypatch.setattr(scalarized, "inspect", seen.append)
    written = fused.scalarize(jnp.sin, 1.0)
    assert seen == [written]
