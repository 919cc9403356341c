"""What the results need, in the order in which it is computed.

A *schedule* is a list of steps. A step is a node, a call, a loop or a gate; the latter two have a
schedule of their own, and keep only the values that something reads.

``accumulators`` finds values of a loop that need no copy from one iteration to the next. A
Humanoid's step carries 1,441 numbers, of which the next stage reads 119; the others are read after
the loop. And a loop over contacts adds those that push to a matrix, in a branch. The matrix has
more entries than there are registers, and as values of the loop they would be copied around the
branch, also where it is skipped.
"""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from mjx_reinforce.engine.scalar.nodes import SELECT, Call, Gate, Loop, Node, Scalar, Scope


class Out(NamedTuple):
    """One result of a gate.

    leaf: the node that stands for it after the gate.
    hot: its value at the end of the body.
    cold: its value if the body is skipped; computed before the gate.
    """

    leaf: Node
    hot: Scalar
    cold: Scalar


class Carry(NamedTuple):
    """One value that a loop changes.

    leaf: the node that stands for it in the body.
    init: its value before the loop; zero where nothing reads that.
    next: its value at the end of the body.
    out: the node that stands for it after the loop.
    """

    leaf: Node
    init: Scalar
    next: Scalar
    out: Node


class Element(NamedTuple):
    """One value that a loop reads from a list, another one in each iteration.

    leaf: the node that stands for it in the body.
    values: its value in each iteration; computed before the loop.
    """

    leaf: Node
    values: list[Scalar]


class Record(NamedTuple):
    """One value that a loop keeps of each iteration.

    value: its value at the end of the body.
    outs: the nodes that stand for it after the loop, one for each iteration.
    """

    value: Scalar
    outs: list[Node]


@dataclasses.dataclass(frozen=True)
class LiveGate:
    """A branch that runs only if some lane needs it.

    predicate: which lanes need the branch.
    body: what it computes.
    outs: its results.
    is_skippable: whether it is of ``skippable``, and not of a condition.
    """

    predicate: Node
    body: "Schedule"
    outs: list[Out]
    is_skippable: bool


@dataclasses.dataclass(frozen=True)
class LiveLoop:
    """A loop.

    length: the number of iterations, or None for no limit.
    active: the position in ``carries`` of the bool that ends the loop when no lane has it; None
      if the loop always runs to its length.
    body: what one iteration computes.
    carries: what it changes.
    elements: what it reads.
    records: what it keeps.
    """

    length: int | None
    active: int | None
    body: "Schedule"
    carries: list[Carry]
    elements: list[Element]
    records: list[Record]


Schedule = list[Node | LiveGate | LiveLoop | Call]


def results(step: LiveGate | LiveLoop | Call) -> list[Node]:
    """Returns the nodes that stand for the results of a step."""
    if isinstance(step, LiveGate):
        return [out.leaf for out in step.outs]
    if isinstance(step, Call):
        return [x for out in step.outs for x in out]
    outs = [carry.out for carry in step.carries]
    return [*outs, *(x for record in step.records for x in record.outs)]


def evenly_spaced(places: Sequence[tuple[Any, int] | None]) -> tuple[Any, int, int] | None:
    """Returns the array, the start and the stride of evenly spaced entries; None for others.

    Args:
      places: the array of each and where it is in it; None for what is in none.
    """
    place = places[0]
    next_place = places[min(1, len(places) - 1)]
    if place is None or next_place is None:
        return None
    array, start = place
    # A single entry is its own next, with a stride of 0.
    stride = next_place[1] - start
    if any(x != (array, start + k * stride) for k, x in enumerate(places)):
        return None
    return array, start, stride


def nodes(body: Schedule) -> Iterator[Node]:
    """Yields the nodes of a schedule, also inside of its loops and gates."""
    return (step for step in _flat(body) if isinstance(step, Node))


def calls(body: Schedule) -> Iterator[Call]:
    """Yields the operations that stay whole, also inside of loops and gates."""
    return (step for step in _flat(body) if isinstance(step, Call))


def _flat(body: Schedule) -> Iterator[Node | Call]:
    for step in body:
        if isinstance(step, Node | Call):
            yield step
        else:
            yield from _flat(step.body)


def schedule(root: Scope, results: Iterable[Scalar]) -> Schedule:
    """Returns what these scalars need, directly or through loops and gates.

    Args:
      root: the scope of the whole program.
      results: scalars of that scope.
    """
    demands = _Needs()
    # A list and no recursion: chains of operands are longer than Python's stack.
    stack = list(results)
    noted_nodes = set()
    while stack:
        node = stack.pop()
        if isinstance(node, Node) and node not in noted_nodes:
            noted_nodes.add(node)
            stack.extend(demands.note(node))
    return demands.steps_of(root)


class _Needs:
    """What was found to be needed so far."""

    def __init__(self) -> None:
        self._steps: dict[Scope, set[Node | Gate | Loop | Call]] = defaultdict(set)
        self._outs: dict[Gate, set[int]] = defaultdict(set)
        # For each loop the positions of what is needed, by its role.
        self._places: dict[Loop, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))

    def note(self, node: Node) -> list[Scalar]:
        """Notes that a node is needed; returns what it needs in turn."""
        owner = node.owner
        if node.op is not None:
            self._steps[node.scope].add(node)
            return list(node.args)
        if isinstance(owner, Gate):
            self._steps[owner.scope].add(owner)
            # Only this result: what others need of the branch is noted when something reads them.
            self._outs[owner].add(node.position)
            return [owner.predicate, owner.hot[node.position], owner.cold[node.position]]
        if isinstance(owner, Call):
            self._steps[owner.scope].add(owner)
            return [x for arg in owner.args for x in arg]
        if isinstance(owner, Loop):
            self._steps[owner.scope].add(owner)
            return self._note_loop(owner, node.position)
        return []

    def _note_loop(self, loop: Loop, position: tuple) -> list[Scalar]:
        """Notes that a leaf of a loop is needed; returns what it needs in turn.

        Args:
          loop: whose leaf it is.
          position: the leaf's role in the loop, its place among those of the role, and more.
        """
        role, i = position[:2]
        if role == "element":
            operands = list(loop.xs[i])
        elif role == "y":
            operands = [loop.ys[i]]
        elif role == "out" and loop.length and loop.active is None:
            # At least one iteration runs and sets it, so nothing reads the init.
            operands = [loop.nexts[i]]
        else:
            # After a loop that may not run at all, the carry is its init.
            role = "carry"
            operands = [loop.inits[i], loop.nexts[i]]
        self._places[loop][role].add(i)
        if loop.active is not None:
            operands.append(loop.carries[loop.active])
        return operands

    def steps_of(self, scope: Scope) -> Schedule:
        """Returns the steps of a scope in order."""
        steps: Schedule = []
        # Steps are numbered as they are made, so what a step reads has a lower number.
        for step in sorted(self._steps[scope], key=lambda step: step.index):
            if isinstance(step, Gate):
                steps.append(self._gate(step))
            elif isinstance(step, Loop):
                steps.append(self._loop(step))
            else:
                steps.append(step)
        return steps

    def _gate(self, gate: Gate) -> LiveGate:
        """Returns a gate with those of its results that are needed."""
        outs = [
            Out(leaf, gate.hot[i], gate.cold[i])
            for i in sorted(self._outs[gate])
            if (leaf := gate.outs[i]) is not None
        ]
        return LiveGate(gate.predicate, self.steps_of(gate.body), outs, gate.is_skippable)

    def _loop(self, loop: Loop) -> LiveLoop:
        """Returns a loop with what is needed of its carry, its elements and its ys."""
        places = {role: sorted(indices) for role, indices in self._places[loop].items()}
        read_carries = set(places.get("carry", ()))
        carry_indices = sorted(read_carries.union(places.get("out", ())))
        carries = []
        for i in carry_indices:
            leaf = loop.carries[i]
            result = loop.outs[i]
            if leaf is not None and result is not None:
                init = loop.inits[i] if i in read_carries else leaf.dtype.type(0)
                carries.append(Carry(leaf, init, loop.nexts[i], result))
        elements = [
            Element(leaf, loop.xs[j])
            for j in places.get("element", [])
            if (leaf := loop.elements[j]) is not None
        ]
        records = [Record(loop.ys[j], loop.stacked[j]) for j in places.get("y", [])]
        active = None
        if loop.active is not None:
            active = carry_indices.index(loop.active)
        return LiveLoop(loop.length, active, self.steps_of(loop.body), carries, elements, records)


def reads(body: Schedule, outputs: Iterable[Scalar] = ()) -> Counter[Node]:
    """Returns how often a schedule, also inside of its steps, and its ends read each node."""
    return Counter(_nodes([*_read_in(body), *outputs]))


def unread(loop: LiveLoop) -> set[Node]:
    """Returns the carries, by their leaves, that the body does not read."""
    return {carry.leaf for carry in loop.carries} - reads(loop.body, _ends(loop)).keys()


def accumulators(loop: LiveLoop) -> dict[Node, Carry]:
    """Returns the carries that may be changed in place, each by the node that is its new value.

    One branch of the body changes such a carry and, until its new value is known, reads it; nothing
    else in the body does. What is selected is left out: LLVM makes stores with masks of it, which
    processors by AMD execute lane by lane.
    """
    num_reads = reads(loop.body, _ends(loop))
    carries = {carry.next: carry for carry in loop.carries if isinstance(carry.next, Node)}
    slots = {}
    for gate in loop.body:
        if not isinstance(gate, LiveGate):
            continue
        branch = _read_by_nodes(gate.body)
        for out in gate.outs:
            carry = carries.get(out.leaf)
            if carry is None or out.cold is not carry.leaf:
                continue
            # The nodes of the branch are the only ones that read it; the gate itself names it once
            # more, as what stays where the branch is skipped.
            is_only_read = num_reads[carry.leaf] == branch.num_reads[carry.leaf] + 1
            # The new value is stored as soon as it is known: no node may read the old one after it.
            is_in_time = branch.last_read.get(carry.leaf, -1) <= branch.places.get(out.hot, -1)
            if (
                num_reads[out.leaf] == 1
                and is_only_read
                and is_in_time
                and out.hot not in slots
                and out.hot.op != SELECT
            ):
                slots[out.hot] = carry
    return slots


def _ends(loop: LiveLoop) -> list[Scalar]:
    """Returns what is read at the end of the body."""
    return [*(carry.next for carry in loop.carries), *(record.value for record in loop.records)]


class _NodeReads(NamedTuple):
    """What the nodes of a schedule read, but not those inside of its loops and gates.

    places: where in the schedule each node is.
    last_read: where a scalar is read last.
    num_reads: how often.
    """

    places: dict[Scalar, int]
    last_read: dict[Scalar, int]
    num_reads: Counter[Node]


def _read_by_nodes(body: Schedule) -> _NodeReads:
    places = {step: k for k, step in enumerate(body) if isinstance(step, Node)}
    last_read = {arg: k for step, k in places.items() for arg in _nodes(step.args)}
    num_reads = Counter(arg for step in places for arg in _nodes(step.args))
    return _NodeReads(places, last_read, num_reads)


def _nodes(scalars: Iterable[Scalar]) -> Iterator[Node]:
    return (x for x in scalars if isinstance(x, Node))


def _read_in(body: Schedule) -> Iterator[Scalar]:
    """Yields what the steps of a schedule read, also inside of them, as often as they do."""
    for step in body:
        if isinstance(step, Node):
            yield from step.args
        elif isinstance(step, LiveGate):
            yield step.predicate
            yield from _read_in(step.body)
            yield from (x for out in step.outs for x in (out.hot, out.cold))
        elif isinstance(step, Call):
            yield from (x for arg in step.args for x in arg)
        else:
            yield from _read_in(step.body)
            yield from (x for carry in step.carries for x in (carry.init, carry.next))
            yield from (x for element in step.elements for x in element.values)
            yield from (record.value for record in step.records)
