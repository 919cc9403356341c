"""Turns the scalar graph into LLVM IR: one instruction on a lane vector for each node."""

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
    """

    pointer: str
    dtype: np.dtype


#: An argument: lane vectors, one after the other.
Input = Memory


#: An operand, or where it lies.
Value = str | Memory


class LLVM(Backend[Value]):
    """Writes LLVM IR into a ``Text``; a value is a lane vector."""

    OPERATIONS = OPERATIONS
    #: So many carries, or more, change in place where they can.
    MANY_CARRIES = 32

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
        pointer, dtype = self._inputs(number)
        return Memory(self._text.at(pointer, dtype, position), dtype)

    def value(self, scalar: Scalar, values: dict[Node, Value]) -> str:
        """Returns a scalar's operand, loading it where it is in memory."""
        value = super().value(scalar, values)
        if isinstance(value, Memory):
            return self._text.load(value.pointer, value.dtype)
        return value

    def node(self, node: Node, operands: list[Value]) -> Value:
        """Writes one operation."""
        op = cast(Op, node.op)  # leaves are not scheduled
        typed_operands = zip(node.args, cast(list[str], operands), strict=True)
        lanes = [Lanes(self._text, np.dtype(arg.dtype), name) for arg, name in typed_operands]
        name = OPERATIONS[op.name](op, node.dtype, *lanes).name
        if node in self._stored:
            self._text.store(name, self._stored[node].pointer, node.dtype)
        return name

    def inside(
        self, body: Schedule, values: dict[Node, Value], leaves: Mapping[Node, Value] | None = None
    ) -> dict[Node, Value]:
        """Runs a body; it may run again, and must find what is outside as it was."""
        free_places = self._free_places
        self._free_places = set()
        scope = super().inside(body, values, leaves)
        self._free_places = free_places
        return scope

    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a branch that is taken if some lane needs it."""
        text = self._text
        is_needed = text.any(self.value(gate.predicate, values))
        # What the branch stores in place needs no phi: the old value stays if it is skipped.
        live_outs = [out for out in gate.outs if out.hot not in self._stored]
        # The phi takes them from the block before the branch, so they must be known there.
        cold_values = [self.value(out.cold, values) for out in live_outs]
        entry_block = text.block
        hot_block = text.label()
        tail = text.label()
        text.line(f"br i1 {is_needed}, label %{hot_block}, label %{tail}")
        text.start(hot_block)
        scope = self.inside(gate.body, values)
        hot_values = [self.value(out.hot, scope) for out in live_outs]
        # Gates and loops in the branch start blocks of their own, so it may end in another block.
        hot_end = text.block
        text.line(f"br label %{tail}")
        text.start(tail)
        gate_values: dict[Node, Value] = {
            out.leaf: text.let(
                f"phi {text.type(out.leaf.dtype)} [{x}, %{entry_block}], [{y}, %{hot_end}]"
            )
            for out, x, y in zip(live_outs, cold_values, hot_values, strict=True)
        }
        return [gate_values.get(out.leaf) or self._stored[cast(Node, out.hot)] for out in gate.outs]

    def loop(self, loop: LiveLoop, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a loop, which ends when no lane goes on or its length is reached."""
        text = self._text
        leaves = self._in_place(loop, values)
        # A loop that runs at least once has its test at the end. It ends with what its last
        # iteration computed, so that a carry that the body does not read needs no phi.
        has_iteration = bool(loop.length) and loop.active is None
        place_leaves = set(leaves)
        if has_iteration:
            place_leaves |= liveness.unread(loop)
        carries = [carry for carry in loop.carries if carry.leaf not in place_leaves]
        inits = [self.value(carry.init, values) for carry in carries]
        readers = [self._reader(e.leaf, e.values, values) for e in loop.elements]
        record_arrays = [text.reserve(r.value.dtype, loop.length or 0) for r in loop.records]
        entry_block = text.block
        head = text.label()
        tail = text.label()
        text.line(f"br label %{head}")
        text.start(head)
        # A phi reads what the body's end computes, and is written when that is known. The first is
        # the number of the iteration.
        holes = [text.hole() for _ in range(len(carries) + 1)]
        count, *phi_names = [hole.name for hole in holes]
        leaves.update(zip((carry.leaf for carry in carries), phi_names, strict=True))
        active = None
        if loop.active is not None:
            active = self.value(loop.carries[loop.active].leaf, leaves)
        if not has_iteration:
            body = text.label()
            text.line(f"br i1 {self._goes_on(loop, count, active)}, label %{body}, label %{tail}")
            text.start(body)
        for element, reader in zip(loop.elements, readers, strict=True):
            leaves[element.leaf] = reader(count)
        scope = self.inside(loop.body, values, leaves)
        for record, array_name in zip(loop.records, record_arrays, strict=True):
            dtype = record.value.dtype
            text.store(self.value(record.value, scope), text.at(array_name, dtype, count), dtype)
        next_values = [self.value(carry.next, scope) for carry in carries]
        types = [text.type(carry.leaf.dtype) for carry in carries]
        next_values = [text.let(f"add i64 {count}, 1"), *next_values]
        branch = f"br label %{head}"
        if has_iteration:
            is_repeated = self._goes_on(loop, next_values[0], active)
            branch = f"br i1 {is_repeated}, label %{head}, label %{tail}"
        for hole, kind, init, following in zip(
            holes, ["i64", *types], ["0", *inits], next_values, strict=True
        ):
            text.fill(hole, f"phi {kind} [{init}, %{entry_block}], [{following}, %{text.block}]")
        text.line(branch)
        text.start(tail)
        # A loop that is left from its head ends with what the phis there hold. What lies in memory
        # is loaded only where it is read.
        if has_iteration:
            final_values = [super(LLVM, self).value(carry.next, scope) for carry in loop.carries]
        else:
            final_values = [leaves[carry.leaf] for carry in loop.carries]
        return [*final_values, *self._recorded_values(loop, record_arrays)]

    def _recorded_values(self, loop: LiveLoop, record_arrays: list[str]) -> list[Value]:
        """Returns where each iteration's value of each record lies, for what comes after the loop.

        Args:
          loop: which has ended.
          record_arrays: pointers to the values of each record.
        """
        places: list[Value] = []
        for record, array_name in zip(loop.records, record_arrays, strict=True):
            dtype = record.value.dtype
            for t, out in enumerate(record.outs):
                self._recorded[out] = (array_name, t)
                places.append(Memory(self._text.at(array_name, dtype, t), dtype))
        return places

    def _in_place(self, loop: LiveLoop, values: dict[Node, Value]) -> dict[Node, Value]:
        """Writes the starts of the carries that change in place; returns where each leaf lies.

        Few carries stay in registers. What only this loop reads of such a loop before it in the
        same body stays where it is.
        """
        accumulators = liveness.accumulators(loop)
        if len(accumulators) < self.MANY_CARRIES:
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

    def _goes_on(self, loop: LiveLoop, count: str, active: str | None) -> str:
        """Returns an i1: whether another iteration runs."""
        text = self._text
        conditions = []
        if loop.length is not None:
            conditions.append(text.let(f"icmp slt i64 {count}, {loop.length}"))
        if active is not None:
            conditions.append(text.any(active))
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
        place = liveness.evenly_spaced([_place_in_input(x) for x in row])
        if place:
            return lambda count: self._place(*place, dtype, count)
        record_place = self._recorded_in_order(row)
        if record_place is not None:
            source, start = record_place

            def read(count: str) -> Value:
                index = count
                if start:
                    index = text.let(f"sub i64 {start}, {count}")
                return Memory(text.at(source, dtype, index), dtype)

            return read
        if all(map(is_constant, row)):
            table_name = text.table(dtype, [literal(x) for x in row])
            return lambda count: text.spread(dtype, table_name, count)
        array_name = text.reserve(dtype, len(row))
        for index, x in enumerate(row):
            text.store(self.value(x, values), text.at(array_name, dtype, index), dtype)
        return lambda count: Memory(text.at(array_name, dtype, count), dtype)

    def _recorded_in_order(self, row: list[Scalar]) -> tuple[str, int] | None:
        """Returns the array in which an earlier loop recorded these values, and where the first is.

        They are there from the start on, or backwards to the start; None if they are not.
        """
        array_name, start = self._recorded.get(row[0], (None, 0))
        if array_name is None:
            return None
        step = -1 if start else 1
        if any(self._recorded.get(x) != (array_name, start + step * k) for k, x in enumerate(row)):
            return None
        return array_name, start

    def _place(self, leaf: int, start: int, stride: int, dtype: np.dtype, count: str) -> Value:
        """Returns where in an argument the element of an iteration lies."""
        pointer, _ = self._inputs(leaf)
        step = self._text.let(f"mul i64 {count}, {stride}")
        index = self._text.let(f"add i64 {step}, {start}")
        return Memory(self._text.at(pointer, dtype, index), dtype)


def _place_in_input(scalar: Scalar) -> tuple[int, int] | None:
    """Returns the number of the argument that a scalar is in and its place there, or None."""
    if isinstance(scalar, Node) and scalar.op is None and scalar.owner is None:
        return scalar.position
    return None
