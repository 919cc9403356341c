"""Which scalars of a program are one formula of other numbers, so that lanes may share them.

Nothing is written here: see ``shared_work``.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

from mjx_reinforce.engine.scalar.nodes import Node, Scalar, is_constant
from mjx_reinforce.engine.team.operations import LONG_FUNCTIONS

#: Fewer scalars of one formula are computed one by one.
MIN_RUN = 4
#: A sum of fewer terms is not worth a meeting of the lanes.
SHORT_SUM = 12
#: Of more nodes no siblings are looked for: that takes long, and the start of an episode, which
#: may have so many, is computed once.
_MOST_NODES = 6_000


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

    def siblings(
        self, scalars: Iterable[Scalar], least: int, is_apart: Callable[[Node], bool]
    ) -> list[Node]:
        """Returns scalars of one formula among all that compute some, where that saves most.

        Args:
          scalars: what is to be computed.
          least: how many operations each is to have for itself; fewer are not worth it.
          is_apart: whether a node is computed, or to be computed, by other means.
        """
        families: dict[int, list[Node]] = {}
        nodes = ancestors(scalars, is_apart)
        if len(nodes) > _MOST_NODES:
            return []
        for node in sorted(nodes, key=lambda node: node.index):
            families.setdefault(self.number(node), []).append(node)
        # What only computes as many siblings is part of their formula.
        parts = {
            self.number(operand)
            for node in nodes
            for operand in node.args
            if operand in nodes
            and len(families[self.number(operand)]) == len(families[self.number(node)])
        }
        most = 0
        best: list[Node] = []
        for number, family in families.items():
            if len(family) > 1 and number not in parts:
                first, second = (ancestors([node], is_apart) for node in family[:2])
                length = len(second - first)
                saved = (len(family) - 1) * length
                is_independent = not ancestors(family[-1].args, is_apart).intersection(family)
                if length >= least and saved > most and is_independent:
                    most = saved
                    best = family
        return best

    def repeated(
        self, scalars: Iterable[Scalar], num_reads: Counter[Node], is_known: Callable[[Node], bool]
    ) -> list[Node]:
        """Returns scalars of one formula that would be computed anew wherever they are read.

        Such are the units of a network's layer, which all units of the next layer read. Returns
        what others are computed from first, and nothing where there is none.

        Args:
          scalars: what is to be computed.
          num_reads: how often each node is read.
          is_known: whether a node is computed.
        """
        num_terms: Counter[Node] = Counter()
        costly = set()
        families: dict[int, list[Node]] = {}
        for node in sorted(ancestors(scalars, is_known), key=lambda node: node.index):
            if node.op is None:
                continue
            inner = [x for x in node.args if isinstance(x, Node) and num_reads[x] == 1]
            if node.op.name == "add" and node.dtype.kind == "f":
                num_terms[node] = 2 + sum(num_terms[x] - 1 for x in inner if num_terms[x])
            is_long = num_terms[node] >= SHORT_SUM or node.op.name in LONG_FUNCTIONS
            if not is_long and costly.isdisjoint(inner):
                continue
            if num_reads[node] == 1:
                costly.add(node)
            else:
                families.setdefault(self.number(node), []).append(node)
        return next((x for x in families.values() if len(x) >= MIN_RUN), [])

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


def ancestors(
    scalars: Iterable[Scalar], is_apart: Callable[[Node], bool] = lambda node: False
) -> set[Node]:
    """Returns the nodes that compute scalars, themselves included.

    Args:
      scalars: what is computed.
      is_apart: which nodes are left out, with what only they are computed from.
    """
    nodes = set()
    stack = list(scalars)
    while stack:
        node = stack.pop()
        if isinstance(node, Node) and node not in nodes and not is_apart(node):
            nodes.add(node)
            stack += node.args
    return nodes


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
