"""Counts the operations of a scalar graph by name; a loop's body counts once."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from mjx_reinforce.fused.backends.backend import Backend
from mjx_reinforce.fused.nodes import Node
from mjx_reinforce.fused.passes.liveness import LiveGate, LiveLoop


class Count(Backend[None]):
    """Makes a ``Counter`` of a scalar graph; values are of no interest."""

    def __init__(self) -> None:
        self._counter: Counter[str] = Counter()

    def constant(self, number: Any) -> None:
        """A constant takes no operation."""

    def leaf(self, node: Node) -> None:
        """Nor does a leaf."""

    def node(self, node: Node, operands: list[None]) -> None:
        """Counts an operation."""
        if node.op is not None:
            self._counter[node.op.name] += 1

    def gate(self, gate: LiveGate, values: dict[Node, None]) -> Sequence[None]:
        """Counts a branch."""
        self.inside(gate.body, values)
        return [None] * len(gate.outs)

    def loop(
        self, loop: LiveLoop, values: dict[Node, None]
    ) -> tuple[Sequence[None], Sequence[Sequence[None]]]:
        """Counts one iteration."""
        self.inside(loop.body, values)
        return [None] * len(loop.carries), [[None] * len(record.outs) for record in loop.records]

    def result(self, outputs: list[list[None]]) -> Counter[str]:
        """Returns the number of operations by name."""
        return self._counter
