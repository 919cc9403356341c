"""Turns the scalar graph back into JAX: one elementwise operation for each node."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jax import lax

from mjx_reinforce.fused import liveness, ops
from mjx_reinforce.fused.branches import Gate
from mjx_reinforce.fused.graph import Captured, Node, Scalar, Scope
from mjx_reinforce.fused.loops import Loop

Environment = dict[Node, Any]


@dataclasses.dataclass(frozen=True)
class Emitter:
    """Emits the operations of a schedule.

    Attributes:
        schedule: what to compute.
        read: the lane of an input, from its position.
        batch_shape: the shape of one lane.
        any_lane: reduces a lane of bools to one bool.
        read_anywhere: whether `read` takes traced positions too.
    """

    schedule: liveness.Schedule
    read: Callable[[Any], Any]
    batch_shape: tuple[int, ...]
    any_lane: Callable[[Any], Any]
    read_anywhere: bool = False

    def results(self, root: Scope, scalars: Sequence[Scalar]) -> list[Any]:
        """Returns the value of each scalar: a lane, a shared value or a constant."""
        env: Environment = {}
        self._run(root, env)
        return [self._value(scalar, env) for scalar in scalars]

    def _run(self, scope: Scope | None, env: Environment) -> None:
        for step in self.schedule.steps.get(scope, ()) if scope else ():
            if isinstance(step, Loop):
                self._loop(step, env)
            elif isinstance(step, Gate):
                self._gate(step, env)
            else:
                env[step] = self._apply(step, env)

    def _apply(self, node: Node, env: Environment) -> Any:
        op = cast(ops.Op, node.op)  # leaves are not scheduled
        values = [self._value(arg, env) for arg in node.args]
        if op.takes_scalars:
            values = [
                value if ops.is_constant(arg) else self._spread(value, node.varying)
                for arg, value in zip(node.args, values, strict=True)
            ]
        else:
            values = [self._spread(value, node.varying) for value in values]
        return op.bind(*values)

    def _value(self, scalar: Scalar, env: Environment) -> Any:
        """Returns a scalar's value, reading inputs when they are first needed."""
        if ops.is_constant(scalar):
            return scalar
        if scalar not in env:
            if isinstance(scalar.owner, Captured):
                env[scalar] = scalar.owner.element(scalar.position)
            else:
                env[scalar] = self.read(scalar.position)
        return env[scalar]

    def _spread(self, value: Any, varying: bool) -> Any:
        """Gives a constant or a shared value the shape of a lane."""
        if varying and np.shape(value) != self.batch_shape:
            return lax.broadcast(value, self.batch_shape)
        return value

    def _materialize(self, scalar: Scalar, varying: bool, env: Environment) -> Any:
        return self._spread(self._value(scalar, env), varying)

    def _gate(self, gate: Gate, env: Environment) -> None:
        live = [out for out in gate.outs if out is not None and out in self.schedule.wanted]

        def branch(scalars: list[Scalar], scope: Scope | None) -> list[Any]:
            inner = dict(env)
            self._run(scope, inner)
            return [self._materialize(scalars[o.position], o.varying, inner) for o in live]

        predicate = ops.any_of(self._value(gate.predicate, env), self.any_lane)
        cold = branch(gate.cold, None)
        hot = functools.partial(branch, gate.hot, gate.body)
        env.update(zip(live, lax.cond(predicate, hot, lambda: cold), strict=True))

    def _loop(self, loop: Loop, env: Environment) -> None:
        carries = self.schedule.carries.get(loop, [])
        live_ys = self.schedule.ys.get(loop, [])
        elements = self.schedule.elements.get(loop, [])
        outs = _leaves(loop.outs, carries)
        carry_leaves = _leaves(loop.carries, carries)
        element_leaves = _leaves(loop.elements, elements)
        varying = [out.varying for out in outs]
        init = [
            self._materialize(loop.inits[i], v, env) for i, v in zip(carries, varying, strict=True)
        ]

        def body(carry: list[Any], row: Sequence[Any] = ()) -> tuple[list[Any], list[Any]]:
            inner = dict(env)
            inner.update(zip(carry_leaves, carry, strict=True))
            inner.update(zip(element_leaves, row, strict=True))
            self._run(loop.body, inner)
            nexts = [
                _computed(self._materialize(loop.nexts[i], v, inner), before)
                for i, v, before in zip(carries, varying, carry, strict=True)
            ]
            return nexts, [self._value(loop.ys[j], inner) for j in live_ys]

        places = self._places([loop.xs[j] for j in elements])
        if places and not live_ys:
            final = lax.fori_loop(
                0,
                loop.length,
                lambda t, carry: body(carry, [self.read(place.at(t)) for place in places])[0],
                init,
            )
        elif live_ys or elements:
            rows = [
                self._stack(loop.xs[j], leaf.varying, env)
                for j, leaf in zip(elements, element_leaves, strict=True)
            ]
            final, stacked = lax.scan(body, init, rows, length=loop.length)
            for j, values in zip(live_ys, stacked, strict=True):
                env.update((leaf, values[t]) for t, leaf in enumerate(loop.stacked[j]))
        else:
            final = self._repeat(loop, carries, body, init)
        env.update(zip(outs, final, strict=True))

    def _places(self, rows: list[list[Scalar]]) -> list["_Places"]:
        """Returns where each row's elements are; nothing if not all can be read in a loop."""
        if not self.read_anywhere:
            return []
        places = [place for row in rows if (place := _evenly_spaced(row))]
        return places if len(places) == len(rows) else []

    def _stack(self, row: list[Scalar], varying: bool, env: Environment) -> jax.Array:
        return jax.numpy.stack([self._materialize(x, varying, env) for x in row])

    def _repeat(self, loop: Loop, carries: list[int], body: Callable, init: list) -> list:
        """Runs a loop that neither reads xs nor makes ys."""
        if loop.active is None:
            return lax.fori_loop(0, loop.length, lambda _, carry: body(carry)[0], init)
        switch = carries.index(loop.active)
        if loop.length is None:
            return lax.while_loop(
                lambda carry: ops.any_of(carry[switch], self.any_lane),
                lambda carry: body(carry)[0],
                init,
            )

        def goes_on(state: tuple[Any, list]) -> Any:
            count, carry = state
            return (count < loop.length) & ops.any_of(carry[switch], self.any_lane)

        start = (np.int32(0), init)
        step = lambda state: (state[0] + 1, body(state[1])[0])  # noqa: E731
        return lax.while_loop(goes_on, step, start)[1]


def _computed(value: Any, before: Any) -> Any:
    """Makes a constant something computed: Triton's lowering takes no literal from a loop."""
    return lax.select(lax.eq(before, before), value, value) if ops.is_constant(value) else value


class _Places(NamedTuple):
    """Evenly spaced elements of one input."""

    leaf: int
    start: int
    stride: int

    def at(self, t: Any) -> tuple[int, Any]:
        """Returns the t-th place; t may be traced."""
        return self.leaf, self.start + self.stride * t


def _evenly_spaced(row: Sequence[Scalar]) -> _Places | None:
    """Tells where the elements of a row are, if they are evenly spaced in one input."""
    if not all(isinstance(x, Node) and x.op is None and x.owner is None for x in row):
        return None
    leaves = {x.position[0] for x in row}
    strides = {b.position[1] - a.position[1] for a, b in itertools.pairwise(row)}
    if len(leaves) != 1 or len(strides) != 1:
        return None
    return _Places(leaves.pop(), row[0].position[1], strides.pop())


def _leaves(leaves: Sequence[Node | None], positions: Sequence[int]) -> list[Node]:
    """Returns the leaves at these positions; what is scheduled has one."""
    return [leaf for i in positions if (leaf := leaves[i]) is not None]
