"""Rules for `while` and `scan`: real loops, that end when no lane needs another iteration."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.fused import arrays, jaxprs, ops
from mjx_reinforce.fused.graph import Graph, Node, Scalar, Scope, same

# Scans at most this long are written out; their constants then fold iteration by iteration.
UNROLLED_LENGTH = 4

Step = Callable[[list[Scalar], list[Scalar]], tuple[list[Scalar], list[Scalar]]]


@dataclasses.dataclass(eq=False, slots=True)
class Loop:
    """A loop over scalars.

    Attributes:
        scope: where the loop runs.
        index: its place among the nodes of that scope.
        length: the number of iterations, or None for no limit.
        inits: what the carry starts from.
        active: the position in the carry of the bool that ends the loop when no lane has it.
        xs: for each element, its value in each iteration.
        body: the scope of one iteration.
        carries: the leaf that stands for each carry; None where the carry never changes.
        elements: the leaf that stands for each of xs; None where it is the same throughout.
        nexts: the carry after one iteration.
        ys: what each iteration adds to the results.
        outs: the leaf that stands for each final carry.
        stacked: the leaf that stands for each of ys in each iteration.
    """

    scope: Scope
    index: int
    length: int | None
    inits: list[Scalar]
    active: int | None
    xs: list[list[Scalar]]
    body: Scope | None = None
    carries: list[Node | None] = dataclasses.field(default_factory=list)
    elements: list[Node | None] = dataclasses.field(default_factory=list)
    nexts: list[Scalar] = dataclasses.field(default_factory=list)
    ys: list[Scalar] = dataclasses.field(default_factory=list)
    outs: list[Node | None] = dataclasses.field(default_factory=list)
    stacked: list[list[Node]] = dataclasses.field(default_factory=list)

    def results(self) -> tuple[list[Scalar], list[list[Scalar]]]:
        """Returns the final carry, and each of ys in each iteration."""
        carry = [
            init if out is None else out for init, out in zip(self.inits, self.outs, strict=True)
        ]
        ys = [
            stacked or [y] * (self.length or 0)
            for y, stacked in zip(self.ys, self.stacked, strict=True)
        ]
        return carry, ys


def iterate(
    graph: Graph,
    step: Step,
    inits: Sequence[Scalar],
    *,
    length: int | None = None,
    active: int | None = None,
    xs: Sequence[list[Scalar]] = (),
) -> Loop:
    """Builds a loop whose carry is only what changes.

    Every carry is first assumed to keep its initial value. The body is evaluated on that
    assumption, carries that break it are dropped from it, and so on until it holds: then it holds
    in every iteration. The same is done for 'all lanes agree'.
    """
    inits = list(inits)
    fixed = [True] * len(inits)
    varying = [_varies(init) for init in inits]
    while True:
        loop = _trace_body(graph, step, inits, fixed, varying, length, active, list(xs))
        moved = [f and not same(n, i) for f, n, i in zip(fixed, loop.nexts, inits, strict=True)]
        spread = [_varies(n) and not v for n, v in zip(loop.nexts, varying, strict=True)]
        fixed = [f and not m for f, m in zip(fixed, moved, strict=True)]
        varying = [v or s for v, s in zip(varying, spread, strict=True)]
        if not any(moved) and not any(s and not f for s, f in zip(spread, fixed, strict=True)):
            return _close(graph, loop, varying)


def _trace_body(
    graph: Graph, step: Step, inits: list, fixed: list, varying: list, length: Any, active: Any,
    xs: list,
) -> Loop:  # fmt: skip
    """Evaluates one iteration under the present assumptions."""
    loop = Loop(graph.scope, 0, length, inits, active, xs)
    with graph.loop_body() as body:
        loop.body = body
        loop.carries = [
            None if f else graph.leaf(init.dtype, v, loop, ("carry", i))
            for i, (f, init, v) in enumerate(zip(fixed, inits, varying, strict=True))
        ]
        loop.elements = [
            None if all(same(x, row[0]) for x in row)
            else graph.leaf(row[0].dtype, any(map(_varies, row)), loop, ("element", j))
            for j, row in enumerate(xs)
        ]  # fmt: skip
        state = [init if c is None else c for init, c in zip(inits, loop.carries, strict=True)]
        parts = [row[0] if e is None else e for row, e in zip(xs, loop.elements, strict=True)]
        certain = set(graph.certain)
        if active is not None and isinstance(state[active], Node):
            graph.certain.add(state[active])
        loop.nexts, loop.ys = step(state, parts)
        graph.certain = certain
    return loop


def _close(graph: Graph, loop: Loop, varying: list[bool]) -> Loop:
    """Gives the loop its place and its results."""
    loop.index = graph.number()
    graph.scope.has_loop = True
    loop.outs = [
        None if carry is None else graph.leaf(carry.dtype, v, loop, ("out", i))
        for i, (carry, v) in enumerate(zip(loop.carries, varying, strict=True))
    ]
    for j, y in enumerate(loop.ys):
        inside = isinstance(y, Node) and y.scope is loop.body
        times = range(loop.length or 0) if inside else ()
        leaves = [graph.leaf(y.dtype, y.varying, loop, ("y", j, t)) for t in times]
        loop.stacked.append(leaves)
    return loop


def while_rule(run: Callable, graph: Graph, eqn: Any, used: Any, *operands: np.ndarray) -> list:
    """A lane that is done keeps its values while others go on."""
    num_cond, num_body = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    cond_consts, body_consts = operands[:num_cond], operands[num_cond : num_cond + num_body]
    carry = _Layout([out.aval for out in eqn.outvars])
    cond, body = (jaxprs.program(eqn.params[name]) for name in ("cond_jaxpr", "body_jaxpr"))

    def goes_on(state: list[Scalar]) -> Scalar:
        return run(graph, cond, [*cond_consts, *carry.pack(state)])[0][()]

    def step(state: list[Scalar], _: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        active, *old = state
        new = carry.unpack(run(graph, body, [*body_consts, *carry.pack(old)]))
        if _varies(active):
            new = [graph.select(active, n, o) for n, o in zip(new, old, strict=True)]
            return [graph.call("and", active, goes_on(new)), *new], []
        return [goes_on(new), *new], []

    start = carry.unpack(operands[num_cond + num_body :])
    active = goes_on(start)
    if ops.is_constant(active) and not active:
        return carry.pack(start)
    loop = iterate(graph, step, [active, *start], active=0)
    return carry.pack(loop.results()[0][1:])


def scan_rule(run: Callable, graph: Graph, eqn: Any, used: Any, *operands: np.ndarray) -> list:
    """A short scan is written out; another becomes a loop, ended early where that is the same."""
    length, parts = eqn.params["length"], jaxprs.scan_parts(eqn)
    body = jaxprs.program(eqn.params["jaxpr"])
    split = parts.num_consts + parts.num_carry
    consts, init = list(operands[: parts.num_consts]), operands[parts.num_consts : split]
    carry = _Layout([out.aval for out in eqn.outvars[: parts.num_carry]])
    outs = _Layout([out.aval for out in body.jaxpr.outvars[parts.num_carry :]])
    ins = _Layout([var.aval for var in body.jaxpr.invars[split:]])
    order = range(length)[::-1] if eqn.params["reverse"] else range(length)

    def step(state: list[Scalar], row: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        results = run(graph, body, [*consts, *carry.pack(state), *ins.pack(row)])
        return carry.unpack(results[: parts.num_carry]), outs.unpack(results[parts.num_carry :])

    rows = [ins.unpack([x[t : t + 1] for x in operands[split:]]) for t in order]
    has_arrays = len(operands) > split or len(eqn.outvars) > parts.num_carry
    limit = UNROLLED_LENGTH if has_arrays else graph.unrolled
    if length <= max(limit, 0 if eqn.params["unroll"] < length else length):
        final, table = _unroll(step, carry.unpack(init), rows)
    else:
        final, table = _as_loop(graph, step, carry.unpack(init), rows, length)
    table = [table[k] for k in np.argsort(order)] if length else []
    stacked = [outs.pack(row) for row in table]
    ys = [np.stack(arrays.together(column)) for column in zip(*stacked, strict=True)]
    if not table:
        ys = [arrays.zeros(out.aval) for out in eqn.outvars[parts.num_carry :]]
    return [*carry.pack(final), *ys]


def _unroll(step: Step, state: list[Scalar], rows: list[list[Scalar]]) -> tuple[list, list]:
    """Runs the iterations one by one; returns the final carry and the ys of each."""
    table = []
    for row in rows:
        state, ys = step(state, row)
        table.append(ys)
    return state, table


def _as_loop(
    graph: Graph, step: Step, inits: list, rows: list[list[Scalar]], length: int
) -> tuple[list, list]:
    """Builds a scan's loop; returns the final carry and the ys of each iteration."""
    xs = [list(column) for column in zip(*rows, strict=True)]
    loop = iterate(graph, step, inits, length=length, xs=xs)
    switch = None if xs or loop.ys else _switch(loop)
    if switch is not None:
        loop = iterate(graph, step, inits, length=length, active=switch)
    final, columns = loop.results()
    return final, [list(row) for row in zip(*columns, strict=True)] or [[]] * length


def _switch(loop: Loop) -> int | None:
    """Finds a bool carry that, once False in a lane, leaves that lane's whole carry as it is.

    MJX's line search is such a scan: its body is cond(active, iterate, identity).
    """
    changing = [i for i, carry in enumerate(loop.carries) if carry is not None]
    for i in changing:
        switch = loop.carries[i]
        if switch is None or switch.dtype != np.bool_:
            continue
        off = [_when_false(loop.nexts[k], switch) for k in changing]
        kept = [np.False_ if k == i else loop.carries[k] for k in changing]
        if all(same(value, before) for value, before in zip(off, kept, strict=True)):
            return i
    return None


def _when_false(value: Scalar, switch: Node) -> Scalar:
    """Returns what a scalar is in a lane where the switch is False, as far as that is plain."""
    if value is switch:
        return np.False_
    if not isinstance(value, Node):
        return value
    gate = value.owner
    if gate is not None and getattr(gate, "predicate", None) is switch:
        return _when_false(gate.cold[value.position], switch)
    if value.op is not None and value.op.name == "select_n" and value.args[0] is switch:
        return _when_false(value.args[1], switch)
    if value.op is not None and value.op.name == "and":
        sides = [_when_false(arg, switch) for arg in value.args]
        if any(ops.is_constant(side) and not side for side in sides):
            return np.False_
    return value


class _Layout:
    """How arrays divide into scalars and back."""

    def __init__(self, avals: Sequence[Any]):
        self._avals = list(avals)

    def pack(self, scalars: Sequence[Scalar]) -> list[np.ndarray]:
        """Makes the arrays of these scalars."""
        values, packed = iter(scalars), []
        for aval in self._avals:
            size = int(np.prod(aval.shape, dtype=int))
            packed.append(arrays.pack([next(values) for _ in range(size)], aval.shape, aval.dtype))
        return packed

    def unpack(self, packed: Sequence[np.ndarray]) -> list[Scalar]:
        """Lists the scalars of these arrays."""
        return [scalar for array in packed for scalar in arrays.elements(array)]


def _varies(scalar: Scalar) -> bool:
    return isinstance(scalar, Node) and scalar.varying
