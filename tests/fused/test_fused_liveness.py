"""What the results need is scheduled, and nothing else."""

import jax.numpy as jnp
from jax import lax

from mjx_reinforce import fused
from mjx_reinforce.fused.nodes import Node
from mjx_reinforce.fused.passes.liveness import LiveGate, LiveLoop


def schedule(function, *examples, cost=1):
    return fused.scalarize(function, *examples, branch_cost=cost).schedule


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
