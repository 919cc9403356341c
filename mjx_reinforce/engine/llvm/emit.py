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
        # Where an earlier loop has recorded a value: the array of that value, and the iteration.
        self._recorded: dict[Scalar, tuple[str, int]] = {}
        # Where a node is stored as soon as it is known: in a carry that changes in place.
        self._stored: dict[Node, Memory] = {}
        self._reads: Counter[Node] = Counter()
        # Such places whose loops have ended, of the body that is being written.
        self._free_places: set[Value] = set()

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
        # The alignment of the first place holds here as far as it divides the distance of the two.
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
        name = OPERATIONS[op.name](op, node.dtype, *lanes).name
        if node in self._stored:
            self._text.store(name, self._stored[node].pointer, node.dtype)
        return name

    def inside(
        self, body: Schedule, values: dict[Node, Value], leaves: Mapping[Node, Value] | None = None
    ) -> dict[Node, Value]:
        """Runs a body; it may run again, and must find what is outside as it was."""
        before = self._free_places
        self._free_places = set()
        inner = super().inside(body, values, leaves)
        self._free_places = before
        return inner

    def some(self, mask: str) -> str:
        """Returns an i1: whether some lane of a mask is set, for a gate or a loop."""
        return self._text.any(mask)

    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a branch that is taken if some lane needs it."""
        text = self._text
        needed = self.some(self.value(gate.predicate, values))
        # What the branch stores in place needs no phi: the old value stays if it is skipped.
        outs = [out for out in gate.outs if out.hot not in self._stored]
        # The phi takes them from the block before the branch, so they must be known there.
        cold = [self.value(out.cold, values) for out in outs]
        before = text.block
        hot_block = text.label()
        after = text.label()
        text.line(f"br i1 {needed}, label %{hot_block}, label %{after}")
        text.start(hot_block)
        inner = self.inside(gate.body, values)
        hot = [self.value(out.hot, inner) for out in outs]
        # Gates and loops in the branch start blocks of their own, so it may end in another block.
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
        leaves = self._in_place(loop, values)
        # A loop that runs at least once has its test at the end. It ends with what its last
        # iteration computed, so that a carry that the body does not read needs no phi.
        at_least_once = bool(loop.length) and loop.active is None
        without_phi = set(leaves)
        if at_least_once:
            without_phi |= liveness.unread(loop)
        carries = [carry for carry in loop.carries if carry.leaf not in without_phi]
        inits = [self.value(carry.init, values) for carry in carries]
        readers = [self._reader(e.leaf, e.values, values) for e in loop.elements]
        arrays = [text.reserve(r.value.dtype, loop.length or 0) for r in loop.records]
        before = text.block
        head = text.label()
        after = text.label()
        text.line(f"br label %{head}")
        text.start(head)
        # A phi reads what the body's end computes, and is written when that is known. The first is
        # the number of the iteration.
        holes = [text.hole() for _ in range(len(carries) + 1)]
        count, *names = [hole.name for hole in holes]
        leaves.update(zip((carry.leaf for carry in carries), names, strict=True))
        active = None
        if loop.active is not None:
            active = self.value(loop.carries[loop.active].leaf, leaves)
        if not at_least_once:
            body = text.label()
            text.line(f"br i1 {self.goes_on(loop, count, active)}, label %{body}, label %{after}")
            text.start(body)
        skipped = self.may_skip(active)
        for element, reader in zip(loop.elements, readers, strict=True):
            leaves[element.leaf] = reader(count)
        inner = self.inside(loop.body, values, leaves)
        for record, array in zip(loop.records, arrays, strict=True):
            dtype = record.value.dtype
            text.store(self.value(record.value, inner), text.at(array, dtype, count), dtype)
        nexts = [self.value(carry.next, inner) for carry in carries]
        kinds = [text.type(carry.leaf.dtype) for carry in carries]
        if skipped:
            nexts = self._joined(*skipped, kinds, names, nexts)
        nexts = [text.let(f"add i64 {count}, 1"), *nexts]
        branch = f"br label %{head}"
        if at_least_once:
            runs_again = self.goes_on(loop, nexts[0], active)
            branch = f"br i1 {runs_again}, label %{head}, label %{after}"
        for hole, kind, init, following in zip(
            holes, ["i64", *kinds], ["0", *inits], nexts, strict=True
        ):
            text.fill(hole, f"phi {kind} [{init}, %{before}], [{following}, %{text.block}]")
        text.line(branch + self.BACK)
        text.start(after)
        # A loop that is left from its head ends with what the phis there hold. What lies in memory
        # is loaded only where it is read.
        if at_least_once:
            finals = [super(LLVM, self).value(carry.next, inner) for carry in loop.carries]
        else:
            finals = [leaves[carry.leaf] for carry in loop.carries]
        return [*finals, *self._recorded_values(loop, arrays)]

    def _recorded_values(self, loop: LiveLoop, arrays: list[str]) -> list[Value]:
        """Returns where each iteration's value of each record lies, for what comes after the loop.

        Args:
          loop: which has ended.
          arrays: pointers to the values of each record.
        """
        places: list[Value] = []
        for record, array in zip(loop.records, arrays, strict=True):
            dtype = record.value.dtype
            for t, out in enumerate(record.outs):
                self._recorded[out] = (array, t)
                places.append(Memory(self._text.at(array, dtype, t), dtype))
        return places

    def _in_place(self, loop: LiveLoop, values: dict[Node, Value]) -> dict[Node, Value]:
        """Writes the starts of the carries that change in place; returns where each leaf lies.

        Few carries stay in registers. What only this loop reads of such a loop before it in the
        same body stays where it is.
        """
        accumulators = liveness.accumulators(loop)
        if len(accumulators) < self.MANY:
            return {}
        places: dict[Node, Value] = {}
        for node, carry in accumulators.items():
            start = super().value(carry.init, values)
            # This loop may write over the place of an earlier loop of the same body, if nothing
            # else reads it. What lies outside of the body must stay as it is for the body's next
            # run.
            if start in self._free_places and self._reads[carry.init] == 1:
                place = cast(Memory, start)
            else:
                place = Memory(self._text.reserve(node.dtype, 1), node.dtype)
                self._text.store(self.value(carry.init, values), place.pointer, place.dtype)
            places[carry.leaf] = place
            self._stored[node] = place
        self._free_places.update(places.values())
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
        text = self._text
        end = text.block
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
        """Returns what an element is in the iteration of a number, an i64.

        A row that lies in memory already is read there: in an argument, or where an earlier loop
        has recorded it. Constants become a table. Other values are stored in front of the loop.
        """
        text = self._text
        dtype = leaf.dtype
        spaced = liveness.evenly_spaced([_place_in_input(x) for x in row])
        if spaced:
            return lambda count: self._place(*spaced, dtype, count)
        recorded = self._recorded_in_order(row)
        if recorded is not None:
            source, first = recorded

            def read(count: str) -> Value:
                index = count
                if first:
                    index = text.let(f"sub i64 {first}, {count}")
                return Memory(text.at(source, dtype, index), dtype)

            return read
        if all(map(is_constant, row)):
            table = text.table(dtype, [literal(x) for x in row])
            return lambda count: text.spread(dtype, table, count)
        array = text.reserve(dtype, len(row))
        for t, x in enumerate(row):
            text.store(self.value(x, values), text.at(array, dtype, t), dtype)
        return lambda count: Memory(text.at(array, dtype, count), dtype)

    def _recorded_in_order(self, row: list[Scalar]) -> tuple[str, int] | None:
        """Returns the array in which an earlier loop recorded these values, and where the first is.

        They are there from the start on, or backwards to the start; None if they are not.
        """
        array, first = self._recorded.get(row[0], (None, 0))
        if array is None:
            return None
        step = -1 if first else 1
        if any(self._recorded.get(x) != (array, first + step * t) for t, x in enumerate(row)):
            return None
        return array, first

    def _place(self, leaf: int, start: int, stride: int, dtype: np.dtype, count: str) -> Value:
        """Returns where in an argument the element of an iteration lies."""
        pointer, _, align = self._inputs(leaf)
        step = self._text.let(f"mul i64 {count}, {stride}")
        index = self._text.let(f"add i64 {step}, {start}")
        # Every place that the loop reads is a multiple of this.
        align = math.gcd(align, dtype.itemsize * stride, dtype.itemsize * start)
        return Memory(self._text.at(pointer, dtype, index), dtype, align)


def _place_in_input(scalar: Scalar) -> tuple[int, int] | None:
    """Returns the number of the argument that a scalar is in and its place there, or None."""
    if isinstance(scalar, Node) and scalar.op is None and scalar.owner is None:
        return scalar.position
    return None
