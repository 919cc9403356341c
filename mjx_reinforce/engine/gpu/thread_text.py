"""C++ of a scalar graph for a thread that plays an episode, beside the others of its block.

A long program does not fit into the instruction caches of a multiprocessor. Threads that read it
at different places wait for instructions most of the time; in step, one reads them for all.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence

from mjx_reinforce.engine.scalar.nodes import Node, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import Carry, LiveGate, LiveLoop, Schedule
from mjx_reinforce.engine.team.cpp import Cpp
from mjx_reinforce.engine.team.operations import type_of

#: Gates and loops of more operations are entered by all threads of a block at once.
LONG_BODY = 3_000
#: What may leave the range of its type, where C++ has no result for integers with a sign.
_MAY_OVERFLOW = ("add", "sub", "mul")


def is_long(body: Schedule) -> bool:
    """Returns whether a body, or a program, is too long for the instruction caches."""
    return sum(1 for _ in liveness.nodes(body)) > LONG_BODY


class ThreadText(Cpp):
    """Writes C++ for one of the threads of a block, all of which run what it writes."""

    def __init__(self, inputs: Callable[[int], str], groups: Mapping[str, int]):
        """Says where the inputs are.

        Args:
          inputs: the array of an argument by its number.
          groups: of how many entries an item of such an array is, a ``Group`` of ``thread.h``.
        """
        super().__init__()
        self._inputs = inputs
        self._groups = groups
        self._is_lockstep = True
        # Where an earlier loop has recorded a value: the array, and the iteration.
        self._recorded: dict[Scalar, tuple[str, int]] = {}

    def leaf(self, node: Node) -> str:
        """An input is read where it is used."""
        number, k = node.position
        return self._entry(self._inputs(number), k)

    def node(self, node: Node, operands: list[str]) -> str:
        """Writes one operation."""
        assert node.op is not None
        if node.op.name in _MAY_OVERFLOW and node.dtype.kind == "i":
            operands = [f"(unsigned)({x})" for x in operands]
        return super().node(node, operands)

    def gate(self, gate: LiveGate, values: dict[Node, str]) -> Sequence[str]:
        """Writes a branch: a long one is taken by all threads if one needs it.

        What is skippable is entered by those threads alone that need it. Few do, and the others
        would read and write as much memory as they.
        """
        names = [self.name() for _ in gate.outs]
        for name, out in zip(names, gate.outs, strict=True):
            self.line(f"{type_of(out.leaf.dtype)} {name} = {self.value(out.cold, values)};")
        predicate = self.value(gate.predicate, values)
        with self._going_through([] if gate.is_skippable else gate.body):
            self.line(f"if ({self._some(predicate)}) {{")
            scope = self.inside(gate.body, values)
            for name, out in zip(names, gate.outs, strict=True):
                self.line(f"{name} = {self.value(out.hot, scope)};")
            self.line("}")
        return names

    def loop(self, loop: LiveLoop, values: dict[Node, str]) -> Sequence[str]:
        """Writes a loop: a long one goes on for all threads until none needs it."""
        carry_names = [self.name() for _ in loop.carries]
        for name, carry in zip(carry_names, loop.carries, strict=True):
            self.line(f"{type_of(carry.leaf.dtype)} {name} = {self.value(carry.init, values)};")
        rows = [self.row(element.values, values) for element in loop.elements]
        array_names = [self.name() for _ in loop.records]
        for name, record in zip(array_names, loop.records, strict=True):
            self.line(f"{type_of(record.value.dtype)} {name}[{loop.length}];")
        count = self.name()
        leaves = dict(zip((carry.leaf for carry in loop.carries), carry_names, strict=True))
        leaves |= {
            element.leaf: row(count) for element, row in zip(loop.elements, rows, strict=True)
        }
        with self._going_through(loop.body):
            self._repeat(loop, count, leaves, values, carry_names, array_names)
        entries = list(carry_names)
        for name, record in zip(array_names, loop.records, strict=True):
            self._recorded |= {out: (name, t) for t, out in enumerate(record.outs)}
            entries += [f"{name}[{t}]" for t in range(len(record.outs))]
        return entries

    def _repeat(
        self,
        loop: LiveLoop,
        count: str,
        leaves: Mapping[Node, str],
        values: dict[Node, str],
        carry_names: list[str],
        array_names: list[str],
    ) -> None:
        """Writes the iterations of a loop, the number of which is ``count``."""
        active = "" if loop.active is None else carry_names[loop.active]
        conditions = [] if loop.length is None else [f"{count} < {loop.length}"]
        if active:
            conditions.append(self._some(active))
        # Both are computed: the threads meet in the second one.
        condition = " & ".join(conditions)
        # A loop that runs at least once has its test at the end.
        has_iteration = bool(loop.length) and not active
        # NVIDIA's compiler would write out the loop over all contacts of a model.
        self.line(f"int {count} = 0;")
        self.line("LOOP do {" if has_iteration else f"LOOP while ({condition}) {{")
        gathers = self._is_lockstep and not active
        # Threads that only wait for others in a loop skip its body. Then only some threads are in
        # the body, and a barrier in it would wait for the others forever.
        skips = self._is_lockstep and bool(active)
        if skips:
            self.line(f"if ({active}) {{")
            self._is_lockstep = False
        scope = self.inside(loop.body, values, leaves)
        for name, record in zip(array_names, loop.records, strict=True):
            self.line(f"{name}[{count}] = {self.value(record.value, scope)};")
        self._carry_on(loop.carries, carry_names, [self.value(x.next, scope) for x in loop.carries])
        if skips:
            self.line("}")
        self.line(f"{count}++;")
        if gathers:
            self.line("t.gather();")
        self.line(f"}} while ({condition});" if has_iteration else "}")

    def _carry_on(self, carries: Sequence[Carry], names: list[str], nexts: list[str]) -> None:
        """Writes what the next iteration starts from."""
        # What is carried to another carry is kept before any of them changes.
        for k, (carry, following) in enumerate(zip(carries, nexts, strict=True)):
            if following in names and following != names[k]:
                nexts[k] = self.name()
                self.line(f"const {type_of(carry.leaf.dtype)} {nexts[k]} = {following};")
        for name, following in zip(names, nexts, strict=True):
            if following != name:
                self.line(f"{name} = {following};")

    def _some(self, flag: str) -> str:
        """Returns whether a thread goes on, or where all do, whether one must."""
        return f"t.meet({flag})" if self._is_lockstep else flag

    @contextlib.contextmanager
    def _going_through(self, body: Schedule) -> Iterator[None]:
        """Lets all threads enter a body at once if it is long, and is not within a short one."""
        is_lockstep = self._is_lockstep
        self._is_lockstep = is_lockstep and is_long(body)
        yield
        self._is_lockstep = is_lockstep

    def spaced(self, row: Sequence[Scalar]) -> Callable[[str], str] | None:
        """Returns what the k-th of evenly spaced elements of one array is; None for others."""
        spacing = liveness.evenly_spaced([self._place(x) for x in row])
        if not spacing:
            return None
        array, start, stride = spacing
        return lambda count: self._entry(array, start, stride, count)

    def _place(self, x: Scalar) -> tuple[str, int] | None:
        """Returns the array that a scalar is an entry of, and which; None for one in none."""
        if is_constant(x):
            return None
        if x.op is None and x.owner is None:
            number, k = x.position
            return self._inputs(number), k
        return self._recorded.get(x)

    def _entry(self, array: str, k: int, stride: int = 0, count: str = "") -> str:
        """Returns entry ``k + stride * count`` of an array."""
        size = self._groups.get(array, 1)
        # Neighbors of one group, which are read by their numbers in it, are loaded together.
        if stride % size:
            return f"{array}->x[{k} + {stride} * {count}]"
        index = f"{k // size}"
        if stride:
            index += f" + {stride // size} * {count}"
        return f"{array}[{index}].x[{k % size}]" if array in self._groups else f"{array}[{index}]"
