"""Turns the scalar graph into LLVM IR: one instruction on a lane vector for each node."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from mjx_reinforce.engine.llvm.lanes import Lanes
from mjx_reinforce.engine.llvm.operations import OPERATIONS
from mjx_reinforce.engine.llvm.text import Text, literal
from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.nodes import Node, Op, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule


class Memory(NamedTuple):
    """A value that stays in memory and is loaded wherever it is used: registers are few.

    pointer: where its lane vector lies; the first one of an input, which stays until the end.
    dtype: of the entries.
    align: bytes of which the pointer is known to be a multiple; 1 leaves it to the dtype.
      Neighbors that are known to be aligned are loaded together.
    """

    pointer: str
    dtype: np.dtype
    align: int = 1


#: An argument: lane vectors, one after the other.
Input = Memory


#: An operand, or where it lies.
Value = str | Memory


class LLVM(Backend[Value]):
    """Writes LLVM IR into a ``Text``; a value is a lane vector."""

    OPERATIONS = OPERATIONS
    #: So many carries, or more, change in place where they can.
    MANY = 32
    #: What the branch back to the start of a loop tells LLVM.
    BACK = ""

    def __init__(self, text: Text, inputs: Callable[[int], Input]):
        """Says what is written into, and where the inputs are.

        Args:
          text: the body of a function.
          inputs: an argument by its number.
        """
        self._text = text
        self._inputs = inputs
        # Where a loop before has kept a value: the array of that value, and the iteration.
        self._kept: dict[Scalar, tuple[str, int]] = {}
        # Where a node is stored as soon as it is known: in a carry that changes in place.
        self._stored: dict[Node, Memory] = {}
        self._reads: Counter[Node] = Counter()
        # Such places that loops in the body that is being written have left.
        self._left: set[Value] = set()

    def compile(self, schedule: Schedule, outputs: list[list[Scalar]]) -> Any:
        """Writes a whole program; returns the value of each element of each output."""
        self._reads = liveness.reads(schedule)
        self._reads.update(x for leaf in outputs for x in leaf if isinstance(x, Node))
        return super().compile(schedule, outputs)

    def constant(self, number: Any) -> Value:
        """A constant in every lane."""
        return self._text.constant(number)

    def leaf(self, node: Node) -> Value:
        """An input stays in memory."""
        number, position = node.position
        pointer, dtype, align = self._inputs(number)
        align = math.gcd(align, dtype.itemsize * position)
        return Memory(self._text.at(pointer, dtype, position), dtype, align)

    def value(self, scalar: Scalar, values: dict[Node, Value]) -> str:
        """Returns a scalar's operand, loading it where it is in memory."""
        value = super().value(scalar, values)
        if isinstance(value, Memory):
            return self._text.load(value.pointer, value.dtype, value.align)
        return value

    def node(self, node: Node, operands: list[Value]) -> Value:
        """Writes one operation."""
        op = cast(Op, node.op)  # leaves are not scheduled
        named = zip(node.args, cast(list[str], operands), strict=True)
        lanes = [Lanes(self._text, np.dtype(arg.dtype), name) for arg, name in named]
        made = OPERATIONS[op.name](op, node.dtype, *lanes).name
        if node in self._stored:
            self._text.store(made, self._stored[node].pointer, node.dtype)
        return made

    def inside(
        self, body: Schedule, values: dict[Node, Value], known: Mapping[Node, Value] | None = None
    ) -> dict[Node, Value]:
        """Runs a body; it may run again, and must find what is outside as it was."""
        before, self._left = self._left, set()
        inner = super().inside(body, values, known)
        self._left = before
        return inner

    def some(self, mask: str) -> str:
        """Returns an i1: whether some lane of a mask is set, for a gate or a loop."""
        return self._text.any(mask)

    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a branch that is taken if some lane needs it."""
        text = self._text
        needed = self.some(self.value(gate.predicate, values))
        outs = [out for out in gate.outs if out.hot not in self._stored]
        cold = [self.value(out.cold, values) for out in outs]
        before, hot_block, after = text.block, text.label(), text.label()
        text.line(f"br i1 {needed}, label %{hot_block}, label %{after}")
        text.start(hot_block)
        inner = self.inside(gate.body, values)
        hot = [self.value(out.hot, inner) for out in outs]
        hot_end = text.block
        text.line(f"br label %{after}")
        text.start(after)
        chosen: dict[Node, Value] = {
            out.leaf: text.let(
                f"phi {text.type(out.leaf.dtype)} [{x}, %{before}], [{y}, %{hot_end}]"
            )
            for out, x, y in zip(outs, cold, hot, strict=True)
        }
        return [chosen.get(out.leaf) or self._stored[cast(Node, out.hot)] for out in gate.outs]

    def loop(self, loop: LiveLoop, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a loop, which ends when no lane goes on or its length is reached."""
        text = self._text
        known = self._in_place(loop, values)
        at_least_once = bool(loop.length) and loop.active is None
        idle = known.keys() | (liveness.unread(loop) if at_least_once else set())
        carries = [carry for carry in loop.carries if carry.leaf not in idle]
        inits = [self.value(carry.init, values) for carry in carries]
        readers = [self._reader(e.leaf, e.values, values) for e in loop.elements]
        kept = [text.reserve(r.value.dtype, loop.length or 0) for r in loop.records]
        before, head, after = text.block, text.label(), text.label()
        text.line(f"br label %{head}")
        text.start(head)
        holes = [text.hole() for _ in range(len(carries) + 1)]
        count, *names = [hole.name for hole in holes]
        known.update(zip((carry.leaf for carry in carries), names, strict=True))
        active = None if loop.active is None else self.value(loop.carries[loop.active].leaf, known)
        if not at_least_once:
            body = text.label()
            text.line(f"br i1 {self.goes_on(loop, count, active)}, label %{body}, label %{after}")
            text.start(body)
        skipped = self.may_skip(active)
        for element, reader in zip(loop.elements, readers, strict=True):
            known[element.leaf] = reader(count)
        inner = self.inside(loop.body, values, known)
        for record, array in zip(loop.records, kept, strict=True):
            dtype = record.value.dtype
            text.store(self.value(record.value, inner), self._text.at(array, dtype, count), dtype)
        nexts = [self.value(carry.next, inner) for carry in carries]
        kinds = [text.type(carry.leaf.dtype) for carry in carries]
        if skipped:
            nexts = self._joined(*skipped, kinds, names, nexts)
        nexts = [text.let(f"add i64 {count}, 1"), *nexts]
        again = self.goes_on(loop, nexts[0], active) if at_least_once else None
        for hole, kind, init, following in zip(
            holes, ["i64", *kinds], ["0", *inits], nexts, strict=True
        ):
            text.fill(hole, f"phi {kind} [{init}, %{before}], [{following}, %{text.block}]")
        ends_or_not = f"i1 {again}, label %{head}, label %{after}" if again else f"label %{head}"
        text.line(f"br {ends_or_not}{self.BACK}")
        text.start(after)
        for record, array in zip(loop.records, kept, strict=True):
            self._kept.update({out: (array, t) for t, out in enumerate(record.outs)})
        ends = [
            super(LLVM, self).value(carry.next, inner) if at_least_once else known[carry.leaf]
            for carry in loop.carries
        ]
        for record, array in zip(loop.records, kept, strict=True):
            dtype = record.value.dtype
            ends += [Memory(text.at(array, dtype, t), dtype) for t in range(len(record.outs))]
        return ends

    def _in_place(self, loop: LiveLoop, values: dict[Node, Value]) -> dict[Node, Value]:
        """Writes the starts of the carries that change in place; returns where each leaf lies.

        Few carries stay in registers. What only this loop reads of such a loop before it in the
        same body stays where it is.
        """
        changed = liveness.accumulators(loop)
        if len(changed) < self.MANY:
            return {}
        places: dict[Node, Value] = {}
        for node, carry in changed.items():
            start = super().value(carry.init, values)
            if start in self._left and self._reads[carry.init] == 1:
                place = cast(Memory, start)
            else:
                place = Memory(self._text.reserve(node.dtype, 1), node.dtype)
                self._text.store(self.value(carry.init, values), place.pointer, place.dtype)
            places[carry.leaf] = self._stored[node] = place
        self._left.update(places.values())
        return places

    def may_skip(self, active: str | None) -> tuple[str, str] | None:
        """Writes at the start of a loop's body a branch around it, for what does not go on.

        Returns:
          The block with the branch, and the one to come behind the body; None for no branch.
        """
        return None

    def _joined(
        self, before: str, after: str, kinds: list[str], olds: list[str], news: list[str]
    ) -> list[str]:
        """Ends a body that may have been skipped; returns the carries."""
        text, end = self._text, self._text.block
        text.line(f"br label %{after}")
        text.start(after)
        return [
            text.let(f"phi {kind} [{old}, %{before}], [{new}, %{end}]")
            for kind, old, new in zip(kinds, olds, news, strict=True)
        ]

    def goes_on(self, loop: LiveLoop, count: str, active: str | None) -> str:
        """Returns an i1: whether another iteration runs."""
        text = self._text
        conditions = []
        if loop.length is not None:
            conditions.append(text.let(f"icmp slt i64 {count}, {loop.length}"))
        if active is not None:
            conditions.append(self.some(active))
        if len(conditions) == 2:
            return text.let(f"and i1 {conditions[0]}, {conditions[1]}")
        return conditions[0]

    def _reader(
        self, leaf: Node, row: list[Scalar], values: dict[Node, Value]
    ) -> Callable[[str], Value]:
        """Returns what an element is in the iteration of a number, an i64."""
        text, dtype = self._text, leaf.dtype
        is_input = lambda x: isinstance(x, Node) and x.op is None and x.owner is None  # noqa: E731
        spaced = liveness.evenly_spaced([x.position if is_input(x) else None for x in row])
        if spaced:
            return lambda count: self._place(*spaced, dtype, count)
        kept = self._kept_in_order(row)
        if kept is not None:
            kept_in, first = kept
            index = lambda count: text.let(f"sub i64 {first}, {count}") if first else count  # noqa: E731
            return lambda count: Memory(text.at(kept_in, dtype, index(count)), dtype)
        if all(map(is_constant, row)):
            table = text.table(dtype, [literal(x) for x in row])
            return lambda count: text.spread(dtype, table, count)
        array = self._text.reserve(dtype, len(row))
        for t, x in enumerate(row):
            text.store(self.value(x, values), self._text.at(array, dtype, t), dtype)
        return lambda count: Memory(self._text.at(array, dtype, count), dtype)

    def _kept_in_order(self, row: list[Scalar]) -> tuple[str, int] | None:
        """Returns the array in which an earlier loop has kept these values, and where the first is.

        They are there from the start on, or backwards to the start; None if they are not.
        """
        array, first = self._kept.get(row[0], (None, 0))
        step = -1 if first else 1
        in_order = all(self._kept.get(x) == (array, first + step * t) for t, x in enumerate(row))
        return (array, first) if array and in_order else None

    def _place(self, leaf: int, start: int, stride: int, dtype: np.dtype, count: str) -> Value:
        pointer, _, align = self._inputs(leaf)
        step = self._text.let(f"mul i64 {count}, {stride}")
        index = self._text.let(f"add i64 {step}, {start}")
        align = math.gcd(align, dtype.itemsize * stride, dtype.itemsize * start)
        return Memory(self._text.at(pointer, dtype, index), dtype, align)
