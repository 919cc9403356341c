"""What all C++ of a scalar graph has in common: lines, names, and one statement for a scalar."""

import abc
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.nodes import Node, Scalar, is_constant
from mjx_reinforce.engine.team.operations import expression, literal, type_of


class Cpp(Backend[str]):
    """Writes C++ into ``lines``; a value is an expression without side effects."""

    def __init__(self):
        """Starts an empty text."""
        self.lines: list[str] = []
        self._count = 0

    def line(self, text: str) -> None:
        """Adds a line."""
        self.lines.append(text)

    def name(self) -> str:
        """Returns a new name."""
        self._count += 1
        return f"v{self._count}"

    def constant(self, number: Any) -> str:
        """A literal."""
        return literal(number)

    def node(self, node: Node, operands: list[str]) -> str:
        """Writes one operation."""
        assert node.op is not None
        name = self.name()
        formula = expression(node.op, node.dtype, [x.dtype for x in node.args], operands)
        self.line(f"const {type_of(node.dtype)} {name} = {formula};")
        return name

    def row(self, row: Sequence[Scalar], values: dict[Node, str]) -> Callable[[str], str]:
        """Returns what an element of a loop is in the iteration of a number."""
        if element := self.spaced(row):
            return element
        name = self.name()
        entries = ", ".join(self.value(x, values) for x in row)
        self.line(f"{qualifier(row)} {type_of(row[0].dtype)} {name}[] = {{{entries}}};")
        return lambda count: f"{name}[{count}]"

    @abc.abstractmethod
    def spaced(self, row: Sequence[Scalar]) -> Callable[[str], str] | None:
        """Returns what the k-th of evenly spaced elements of one array is; None for others."""


def qualifier(entries: Sequence[Scalar]) -> str:
    """Returns what a table of scalars is declared as."""
    # A static table is in memory, once for all; another one is made of registers each time. NVRTC
    # makes no static table of what a function returns, as ``literal`` has infinity and NaN.
    if all(is_constant(x) and np.isfinite(x) for x in entries):
        return "static const"
    return "const"
