"""What the lanes of a team compute together: entries of arrays, terms of long sums, costly scalars.

Scalars of one formula of other numbers are a loop whose rounds the lanes share. What they have
computed so is in memory that all of them see, until the branch or the loop around it ends.
"""

import abc
import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mjx_reinforce.engine.scalar.nodes import Node, Scalar, identity, is_constant, same
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.team.cpp import Cpp, qualifier
from mjx_reinforce.engine.team.formulas import MIN_RUN, SHORT_SUM, Formulas, Place, sum_terms
from mjx_reinforce.engine.team.operations import expression, literal, type_of

#: Of a formula with so many operations, or more, the lanes compute any scalars together.
_LONG = 24


class _Sum(NamedTuple):
    """How lanes add up what each of them has added: ``start`` is neutral, ``meet`` a template."""

    start: str
    sign: str
    meet: str


_SUMS = {
    "and": _Sum("true", "&", "!t.any(!{})"),
    "or": _Sum("false", "|", "t.any({})"),
    "add": _Sum("0", "+", "t.sum({})"),
}


class SharedWork(Cpp):
    """Writes what the lanes of a team share; ``text`` writes the program around it.

    words: how many words of 4 bytes ``scratch`` has, so far.
    """

    def __init__(self, uses: Counter[Node]):
        """Starts an empty text.

        Args:
          uses: how often each node of the program is read.
        """
        super().__init__()
        self.words = 0
        self._uses = uses
        self._values: dict[Node, str] = {}
        self._written: dict[Node, Place] = {}
        self._formulas = Formulas(self._place, lambda node: node in self._written)

    @abc.abstractmethod
    def _place(self, scalar: Scalar) -> Place | None:
        """Returns where an argument, a result of a call or an entry of an array is, or None."""

    def _fill(self, array_id: str, scalars: Sequence[Scalar]) -> None:
        """Writes scalars of the program into an array, once what they need is prepared."""
        self._store_repeated(scalars)
        self._share(scalars)
        start = 0
        for run in self._runs(scalars):
            if len(run) < MIN_RUN:
                for k, x in enumerate(run, start=start):
                    self.line(f"if (t.lane == 0) {array_id}[{k}] = {self.value(x, self._values)};")
            else:
                self._each(run, f"{array_id}[{start} + i] = {{}};")
            start += len(run)

    def leaf(self, node: Node) -> str:
        """An input is read where it is used."""
        place = self._place(node)
        assert place is not None
        return f"{place.array}[{place.entry}]"

    def value(self, scalar: Scalar, values: dict[Node, str]) -> str:
        """Returns a scalar, once what it needs is written."""
        # With a stack of its own: a formula may be nested deeper than Python's calls.
        stack = [] if is_constant(scalar) else [scalar]
        while stack:
            node = stack.pop()
            if node in values:
                continue
            if node.op is None:
                values[node] = self.leaf(node)
            elif len(terms := self._terms(node)) >= SHORT_SUM:
                values[node] = self._sum(_SUMS[node.op.name], node.dtype, terms, values)
            elif pending := [x for x in node.args if isinstance(x, Node) and x not in values]:
                stack += [node, *pending]
            else:
                values[node] = self.node(node, [self.value(x, values) for x in node.args])
        return super().value(scalar, values)

    def spaced(self, row: Sequence[Scalar]) -> Callable[[str], str] | None:
        """Returns what the k-th of evenly spaced elements of one array is; None for others."""
        spacing = liveness.evenly_spaced([self._place(x) for x in row])
        if not spacing:
            return None
        array_id, start, stride = spacing
        return lambda count: f"{array_id}[{start} + {stride} * {count}]"

    def _reserve(self, dtype: np.dtype, count: int) -> str:
        """Returns a new array that all lanes of the team see."""
        name = self.name()
        type_name = type_of(dtype)
        size = -(-np.dtype(dtype).itemsize // 4)
        self.words += self.words % size  # numbers of 8 bytes begin at an even word
        self.line(f"{type_name}* {name} = reinterpret_cast<{type_name}*>(scratch + {self.words});")
        self.words += count * size
        return name

    def _read_from(self, array_id: str, scalars: Sequence[Scalar]) -> None:
        """Has scalars read from an array from now on."""
        indices = {x: k for k, x in enumerate(scalars) if isinstance(x, Node) and x.op}
        self._values.update({x: f"{array_id}[{k}]" for x, k in indices.items()})
        self._written.update({x: Place(array_id, k) for x, k in indices.items()})
        self._formulas.forget()  # of what is computed from these, too

    def _runs(self, scalars: Sequence[Scalar]) -> list[list[Scalar]]:
        """Returns neighbors of one formula, which the lanes may compute together."""
        return [list(run) for _, run in itertools.groupby(scalars, self._formulas.number)]

    def _share(self, scalars: Sequence[Scalar]) -> None:
        """Has the lanes compute together, within some scalars, what costs much.

        One by one, as writing some changes what others are computed from.
        """
        while siblings := self._formulas.siblings(scalars, _LONG, self._is_apart):
            self._store(siblings)

    def _store_repeated(self, scalars: Sequence[Scalar]) -> None:
        """Has the lanes compute once what would be computed anew wherever it is read."""
        while repeated := self._formulas.repeated(scalars, self._uses, self._is_known):
            self._store(repeated)

    def _store(self, nodes: Sequence[Node]) -> None:
        """Has the lanes compute nodes of one formula together, into a new array."""
        array_id = self._reserve(nodes[0].dtype, len(nodes))
        self._each(nodes, f"{array_id}[i] = {{}};")
        self.line("t.sync();")
        self._read_from(array_id, nodes)

    def _is_known(self, node: Node) -> bool:
        """Returns whether a node is computed already."""
        return node in self._values or node in self._written

    def _is_apart(self, node: Node) -> bool:
        """Returns whether a node is computed already, or a sum that lanes share."""
        return self._is_known(node) or len(self._terms(node)) >= SHORT_SUM

    def _terms(self, node: Node) -> list[Scalar]:
        """Returns the terms of a sum that the lanes may share; none of what is no such sum."""
        if node.op is None or node.op.name not in _SUMS or node.dtype.kind not in "bf":
            return []
        return sum_terms(node, self._uses)

    def _sum(
        self, kind: _Sum, dtype: np.dtype, terms: list[Scalar], values: dict[Node, str]
    ) -> str:
        """Writes a sum whose terms of one formula the lanes share; returns its name."""
        groups: dict[int, list[Scalar]] = {}
        for x in terms:
            groups.setdefault(self._formulas.number(x), []).append(x)
        name = self.name()
        sum_name = self.name()
        self.line(f"{type_of(dtype)} {name} = {kind.start};")
        # Each lane adds up its terms of each formula, then the lanes meet; what is left is added by
        # all lanes alike.
        lone_terms = []
        for group in groups.values():
            if len(group) < MIN_RUN:
                lone_terms += group
            else:
                self._each(group, f"{name} = {name} {kind.sign} {{}};")
        addends = [kind.meet.format(name), *(self.value(x, values) for x in lone_terms)]
        self.line(f"const {type_of(dtype)} {sum_name} = {f' {kind.sign} '.join(addends)};")
        return sum_name

    def _each(self, run: Sequence[Scalar], statement: str) -> None:
        """Writes a loop in which the lanes share scalars of one formula.

        Args:
          run: the scalars.
          statement: a line that has one of them for its {}, and its number as ``i``.
        """
        tables: list[str] = []
        body: list[str] = []
        formula = self._together(list(run), tables, body)
        self.lines += [*tables, f"EACH(i, {len(run)}) {{", *body, statement.format(formula), "}"]

    def _together(self, run: list[Scalar], tables: list[str], body: list[str]) -> str:
        """Returns scalars of one formula as an expression of their number i.

        Args:
          run: the scalars.
          tables: lines before the loop over i, to which those needed are added.
          body: lines within the loop, likewise.
        """
        # A column is the scalars that stand at one place of the formula, one for each i: the run is
        # the column of the whole formula, and the operands of a column's operations are columns.
        expressions: dict[tuple, str] = {}
        stack = [run]
        while stack:
            column = stack.pop()
            key = tuple(map(identity, column))
            if key in expressions:
                continue
            if value := self._uniform(column, tables):
                expressions[key] = value
                continue
            columns = [list(x) for x in zip(*(x.args for x in column), strict=True)]
            keys = [tuple(map(identity, operand)) for operand in columns]
            pending = [x for x, k in zip(columns, keys, strict=True) if k not in expressions]
            if pending:
                stack += [column, *pending]
                continue
            example = column[0]
            name = self.name()
            dtypes = [x.dtype for x in example.args]
            operands = [expressions[k] for k in keys]
            formula = expression(example.op, example.dtype, dtypes, operands)
            body.append(f"const {type_of(example.dtype)} {name} = {formula};")
            expressions[key] = name
        return expressions[tuple(map(identity, run))]

    def _uniform(self, column: list[Scalar], tables: list[str]) -> str | None:
        """Returns scalars that are all the same, or not computed here; None for others."""
        example = column[0]
        name = self.name()
        if all(same(x, example) for x in column):
            # It is computed before the loop over i, once.
            outer_lines = self.lines
            self.lines = tables
            value = self.value(example, self._values)
            self.lines = outer_lines
            return value
        if element := self.spaced(column):
            return element("i")
        if is_constant(example):
            literals = ", ".join(map(literal, column))
            kind = f"{qualifier(column)} {type_of(example.dtype)}"
            tables.append(f"{kind} {name}[] = {{{literals}}};")
            return f"{name}[i]"
        # Scalars of one form that are in memory are in one array: the form names it.
        places = [x for x in map(self._place, column) if x]
        if places:
            entries = ", ".join(str(x.entry) for x in places)
            tables.append(f"static const int {name}[] = {{{entries}}};")
            return f"{places[0].array}[{name}[i]]"
        return None
