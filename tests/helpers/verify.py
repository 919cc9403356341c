"""``verify``: whether a program that was written out is well formed. The tests ask, users do not.

What graph, algebra, loops and liveness must keep is checked by walking through the schedule as a
backend does: every operand is there before it is used, dtypes and numbers of operands fit, what a
loop carries keeps its dtype, and nothing is computed that nothing reads.
"""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.nodes import BOOL, FACTS, Call, Captured, Node, Op, Scalar
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop
from mjx_reinforce.engine.scalar.rules.iterate import varies
from mjx_reinforce.engine.scalar.scalarized import Scalarized

Dtypes = dict[Node, np.dtype]


def verify(written: Scalarized) -> None:
    """Checks a program.

    Raises:
      AssertionError: it is not well formed; the message says where.
    """
    for aval, scalars in zip(written.out_avals, written.outputs, strict=True):
        _check(len(scalars) == np.prod(aval.shape, dtype=int), "a result has too few scalars")
        _agree("a result", aval.dtype, scalars)
    _Verify().compile(written.schedule, written.outputs)


class _Verify(Backend[np.dtype]):
    """Walks through a schedule; the value of a scalar is its dtype."""

    def __init__(self) -> None:
        self._computed: set[Node] = set()
        self._read: set[Scalar] = set()

    def constant(self, number: Any) -> np.dtype:
        """A constant is there at any time."""
        return number.dtype

    def leaf(self, node: Node) -> np.dtype:
        """An input too; all else that is asked for here should have been computed."""
        is_input = node.op is None and (node.owner is None or isinstance(node.owner, Captured))
        _check(is_input, f"{_node_name(node)} is read where it is not known")
        return node.dtype

    def value(self, scalar: Scalar, values: Dtypes) -> np.dtype:
        """Notes that a scalar is read."""
        self._read.add(scalar)
        return super().value(scalar, values)

    def call(self, call: Call, values: Dtypes) -> list[list[np.dtype]]:
        """Reads what an operation on arrays reads."""
        for arg in call.args:
            _agree(f"an operand of {call.name}", arg[0].dtype if arg else None, arg)
            for x in arg:
                self.value(x, values)
        return [[x.dtype for x in out] for out in call.outs]

    def node(self, node: Node, operands: list[np.dtype]) -> np.dtype:
        """Checks an operation."""
        _check(node not in self._computed, f"{_node_name(node)} is computed twice")
        self._computed.add(node)
        _check(_fits(node, operands), f"{_node_name(node)} takes {operands} to {node.dtype}")
        _check(node.varying == any(map(varies, node.args)), f"{_node_name(node)} varies otherwise")
        return node.dtype

    def gate(self, gate: LiveGate, values: Dtypes) -> Sequence[np.dtype]:
        """Checks a branch."""
        _check(self.value(gate.predicate, values) == BOOL, "a gate's predicate is no bool")
        cold = [self.value(out.cold, values) for out in gate.outs]
        inner = self.inside(gate.body, values)
        for out in gate.outs:
            self.value(out.hot, inner)
            _agree("a gate's result", out.leaf.dtype, [out.hot, out.cold])
            _covers("a gate's result", out.leaf, [out.hot, out.cold])
        return cold

    def loop(
        self, loop: LiveLoop, values: Dtypes
    ) -> tuple[Sequence[np.dtype], Sequence[Sequence[np.dtype]]]:
        """Checks a loop."""
        _check(loop.length is not None or loop.active is not None, "a loop never ends")
        starts = {carry.leaf: self.value(carry.init, values) for carry in loop.carries}
        for element in loop.elements:
            _check(len(element.values) == loop.length, "a loop has too few elements to read")
            for x in element.values:
                self.value(x, values)
            _agree("an element", element.leaf.dtype, element.values)
            _covers("an element", element.leaf, element.values)
        elements = {element.leaf: element.leaf.dtype for element in loop.elements}
        inner = self.inside(loop.body, values, {**starts, **elements})
        for carry in loop.carries:
            self.value(carry.next, inner)
            _agree("a carry", carry.leaf.dtype, [carry.init, carry.next, carry.out])
            _covers("a carry", carry.leaf, [carry.init, carry.next])
            _covers("a carry", carry.out, [carry.leaf])
        if loop.active is not None:
            switch = loop.carries[loop.active].leaf
            _check(switch.dtype == BOOL, "what ends a loop is no bool")
        for record in loop.records:
            self.value(record.value, inner)
            _check(len(record.outs) == loop.length, "a loop keeps too few records")
            _agree("a record", record.value.dtype, record.outs)
            for out in record.outs:
                _covers("a record", out, [record.value])
        outs = [carry.out.dtype for carry in loop.carries]
        return outs, [[out.dtype for out in record.outs] for record in loop.records]

    def result(self, outputs: list[list[np.dtype]]) -> None:
        """Checks that nothing was computed in vain."""
        for node in self._computed - self._read:
            raise AssertionError(f"{_node_name(node)} is computed and never read")


def _fits(node: Node, operands: list[np.dtype]) -> bool:
    """Returns whether an operation takes these operands, and makes what it should of them."""
    op = cast(Op, node.op)  # leaves are not scheduled
    facts, dtype = FACTS[op.name], node.dtype
    if op.name == "select_n":
        which, *cases = operands
        enough = len(cases) == 2 if which == BOOL else len(cases) >= 2 and which.kind in "iu"
        return enough and set(cases) == {dtype}
    if len(operands) != facts.arity:
        return False
    if "new_dtype" in dict(op.params):
        return dict(op.params)["new_dtype"] == dtype
    if op.name == "pow":  # an exponent may be an integer under a float base
        return operands[0] == dtype
    made = BOOL if facts.is_predicate else operands[0]
    return len(set(operands)) == 1 and made == dtype


def _agree(what: str, dtype: DTypeLike, scalars: Sequence[Scalar]) -> None:
    dtypes = {str(scalar.dtype) for scalar in scalars}
    _check(dtypes <= {str(np.dtype(dtype))}, f"{what} is {dtype} and also {sorted(dtypes)}")


def _covers(what: str, leaf: Node, scalars: Sequence[Scalar]) -> None:
    """Checks that a leaf varies from lane to lane if what it stands for does."""
    _check(leaf.varying or not any(map(varies, scalars)), f"{what} does not vary, its value does")


def _node_name(node: Node) -> str:
    return f"{node.op.name if node.op else 'a leaf'} ({node.index})"


def _check(holds: Any, message: str) -> None:
    if not holds:
        raise AssertionError(message)
