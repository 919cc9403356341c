"""Which values of a loop need no copy from one iteration to the next.

A Humanoid's step carries 1,441 numbers, of which the next stage reads 119; the others are read
after the loop. And a loop over contacts adds those that push to a matrix, in a branch. The matrix
has more entries than there are registers, and as values of the loop they would be copied around the
branch, also where it is skipped.
"""

from collections import Counter
from collections.abc import Iterable, Iterator

from mjx_reinforce.engine.scalar.nodes import Node, Scalar
from mjx_reinforce.engine.scalar.ops import SELECT
from mjx_reinforce.engine.scalar.passes.liveness import Carry, LiveGate, LiveLoop, Schedule


def reads(body: Schedule, ends: Iterable[Scalar] = ()) -> Counter[Node]:
    """Returns how often a schedule, also inside of its steps, and its ends read each node."""
    return Counter(_nodes([*_read_in(body), *ends]))


def unread(loop: LiveLoop) -> set[Node]:
    """Returns the carries, by their leaves, that the body does not read."""
    return {carry.leaf for carry in loop.carries} - reads(loop.body, _ends(loop)).keys()


def accumulators(loop: LiveLoop) -> dict[Node, Carry]:
    """Returns the carries that may be changed in place, each by the node that is its new value.

    One branch of the body changes such a carry and, until its new value is known, reads it; nothing
    else in the body does. What is selected is left out: LLVM makes stores with masks of it, which
    processors by AMD execute lane by lane.
    """
    read = reads(loop.body, _ends(loop))
    carries = {carry.next: carry for carry in loop.carries if isinstance(carry.next, Node)}
    found = {}
    for gate in loop.body:
        if isinstance(gate, LiveGate):
            known, last, times = _read_by_nodes(gate.body)
            for out in gate.outs:
                carry = carries.get(out.leaf)
                if (
                    carry is not None
                    and out.cold is carry.leaf
                    and read[out.leaf] == 1
                    and read[carry.leaf] == times[carry.leaf] + 1  # and as what stays if skipped
                    and last.get(carry.leaf, -1) <= known.get(out.hot, -1)
                    and out.hot not in found
                    and out.hot.op != SELECT
                ):
                    found[out.hot] = carry
    return found


def _ends(loop: LiveLoop) -> list[Scalar]:
    """Returns what is read at the end of the body."""
    return [*(carry.next for carry in loop.carries), *(record.value for record in loop.records)]


def _read_by_nodes(body: Schedule) -> tuple[dict[Scalar, int], dict[Scalar, int], Counter[Node]]:
    """Returns where each node is, where a node reads each scalar last, and how often nodes do."""
    nodes = {step: k for k, step in enumerate(body) if isinstance(step, Node)}
    last = {arg: k for step, k in nodes.items() for arg in _nodes(step.args)}
    return nodes, last, Counter(arg for step in nodes for arg in _nodes(step.args))


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
        else:
            yield from _read_in(step.body)
            yield from (x for carry in step.carries for x in (carry.init, carry.next))
            yield from (x for element in step.elements for x in element.values)
            yield from (record.value for record in step.records)
