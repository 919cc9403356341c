"""Which scalars of a program are one formula of other numbers, so that lanes may share them.

Nothing is written here: see ``text``.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from mjx_reinforce.engine.scalar.nodes import Node, Scalar, is_constant


class Place(NamedTuple):
    """An array of scalars in memory, and which of them is meant."""

    array: str
    entry: int


class Formulas:
    """The formulas of scalars, by number: scalars of one number differ in what they read alone."""

    def __init__(self, place: Callable[[Scalar], Place | None], is_stored: Callable[[Node], bool]):
        """Says what is in memory.

        Args:
          place: where a scalar is in memory; None for one that is not.
          is_stored: whether a node that is computed is in memory by now.
        """
        self._place = place
        self._is_stored = is_stored
        self._numbers: dict[tuple, int] = {}
        self._number_of: dict[Node, int] = {}

    def number(self, scalar: Scalar) -> int:
        """Returns a number for the formula of a scalar, whatever its numbers are."""
        if is_constant(scalar):
            return self._numbered(("constant", scalar.dtype.name))
        # With a stack of its own: a formula may be nested deeper than Python's calls.
        stack = [scalar]
        while stack:
            node = stack.pop()
            # What is in memory is told by its place, whatever it was computed from.
            args = () if self._is_stored(node) else node.args
            operands = [x for x in args if isinstance(x, Node) and x not in self._number_of]
            if operands:
                stack += [node, *operands]
            elif node not in self._number_of:
                self._number_of[node] = self._numbered(self._key(node))
        return self._number_of[scalar]

    def forget(self) -> None:
        """Forgets which formula a node is, where it is in memory from now on or no longer."""
        self._number_of.clear()

    def _key(self, node: Node) -> tuple:
        """Returns what tells a formula from others; its operands are numbered before."""
        if place := self._place(node):
            return ("in", place.array)
        if node.op is None:
            return ("itself", node.index)
        return (node.op, node.dtype.name, *(self.number(x) for x in node.args))

    def _numbered(self, key: tuple) -> int:
        return self._numbers.setdefault(key, len(self._numbers))


def sum_terms(node: Node, num_reads: Counter[Node]) -> list[Scalar]:
    """Returns what a node adds up, in order, where nothing else reads the sums between.

    Args:
      node: the sum, or another operation that may be grouped in any way.
      num_reads: how often each node is read.
    """
    stack = list(node.args)
    terms = []
    while stack:
        x = stack.pop()
        if isinstance(x, Node) and x.op == node.op and num_reads[x] == 1:
            stack += x.args
        else:
            terms.append(x)
    return terms[::-1]  # the stack gave the last first
