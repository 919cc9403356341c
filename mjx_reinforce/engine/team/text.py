"""C++ of a scalar graph, for a team of lanes that plays one episode.

A scalar is written where it is first asked for, so that few wait in registers while the physics is
computed. All lanes compute a scalar alike, but for what they share: see ``shared_work``.
"""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import numpy as np

from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import Call, Node, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule
from mjx_reinforce.engine.team.formulas import Place, ancestors
from mjx_reinforce.engine.team.operations import type_of
from mjx_reinforce.engine.team.shared_work import SharedWork

#: What the physics reads, in the order of the operation's operands.
_INPUTS = ("ctrl", "time", "qpos", "qvel", "act", "qacc_warmstart")
#: What it computes for the task alone, where that reads it.
_OUTPUTS = (
    *("xpos", "xipos", "cinert", "cvel", "cfrc_ext"),
    *("pass_qpos", "pass_qvel", "pass_qacc", "touch"),
)
#: Where the device code has the fields of a simulation, by MuJoCo's names.
_STATE = {field: f"s.{field}" for field in (*_INPUTS, *_OUTPUTS, "qfrc_actuator")}
#: The operations that simulate, as the device code has them, and how often teams meet in them.
_SIMULATIONS = {
    "physics": ("const bool {}[1] = {{physics({}, M, s, {})}};", " + {} * STAGES"),
    "start": ("const bool {}[1] = {{true}}; start({}, M, s);", " + 1"),
}


class CText(SharedWork):
    """Writes C++ into ``lines``; a value is an expression without side effects.

    read: the numbers of the arguments that were read, so far.
    first_lines: what is computed once, before the first of many runs of ``lines``.
    first_read: the numbers of the arguments that these lines read.
    reports: what the physics reports, by the names of ``device/state.h``.
    meets: how often teams meet: in the physics outside of branches and loops, as an expression.
    """

    def __init__(
        self,
        program: scalarized.Scalarized,
        inputs: Callable[[int], str],
        steps: int,
        constants: Collection[int] = (),
    ):
        """Says where what is not computed here is.

        Args:
          program: the program.
          inputs: the array of an argument by its number.
          steps: physics steps of a call of "physics".
          constants: the numbers of the arguments that are the same in all runs.
        """
        outputs = [x for leaf in program.outputs for x in leaf]
        super().__init__(liveness.reads(program.schedule, outputs))
        self.read: set[int] = set()
        self.first_lines: list[str] = []
        self.first_read: set[int] = set()
        self._constants = constants
        self.reports: list[str] = []
        self.meets = "0"
        self._depth = 0
        self._inputs = inputs
        self._skip = steps
        self._steps = _owners(program.schedule)
        simulates = [x.name in _SIMULATIONS for x in liveness.calls(program.schedule)]
        self._simulates_once = sum(simulates) == 1
        self._prepared: set[Node] = set()
        self._arrays: dict[tuple[Call, int], str] = {}

    def get(self, scalar: Scalar) -> str:
        """Returns a scalar of the program."""
        self._prepare([scalar])
        self._store_repeated([scalar])
        return self.value(scalar, self._values)

    def array(self, scalars: Sequence[Scalar]) -> str:
        """Returns an array of scalars of the program: where they are, or a new one."""
        spacing = liveness.evenly_spaced([self._place(x) for x in scalars])
        if spacing:
            name, start, stride = spacing
            if stride == int(len(scalars) > 1):  # side by side; that of one scalar is 0
                return f"({name} + {start})"
        array_id = self._reserve(scalars[0].dtype, len(scalars))
        self.keep(array_id, scalars)
        return array_id

    def keep(self, array_id: str, scalars: Sequence[Scalar]) -> None:
        """Writes scalars of the program into an array, from which others are computed then."""
        self.fill(array_id, scalars)
        self.line("t.sync();")
        self._read_from(array_id, scalars)

    def fill(self, array_id: str, scalars: Sequence[Scalar]) -> None:
        """Writes scalars of the program into an array."""
        self._prepare(scalars)
        self._fill(array_id, scalars)

    def gate(self, gate: LiveGate, values: dict[Node, str]) -> Sequence[str]:
        """Writes a branch; what it leaves is in memory, which the lanes fill together."""
        groups: dict[np.dtype, list[liveness.Out]] = {}
        for out in gate.outs:
            groups.setdefault(out.leaf.dtype, []).append(out)
        group_names = [(self._reserve(dtype, len(group)), group) for dtype, group in groups.items()]
        # Both sides fill the same arrays. The body is the first side's; the other side has values
        # of before.
        self.line(f"if ({self.value(gate.predicate, values)}) {{")
        with self._inside(gate.body, {}):
            for array_name, group in group_names:
                self.fill(array_name, [out.hot for out in group])
        self.line("} else {")
        with self._inside([], {}):
            for array_name, group in group_names:
                self.fill(array_name, [out.cold for out in group])
        self.lines += ["}", "t.sync();"]
        # Whichever side was taken, its results are at the same places.
        for array_name, group in group_names:
            self._written.update({out.leaf: Place(array_name, k) for k, out in enumerate(group)})
        return [self.leaf(out.leaf) for out in gate.outs]

    def loop(self, loop: LiveLoop, values: dict[Node, str]) -> Sequence[str]:
        """Writes a loop."""
        local_values = {}
        carry_names = []
        for carry in loop.carries:
            name = self.name()
            init = self.value(carry.init, values)
            self.line(f"{type_of(carry.leaf.dtype)} {name} = {init};")
            carry_names.append(name)
            local_values[carry.leaf] = name
        rows = [self.row(element.values, values) for element in loop.elements]
        array_names = []
        for record in loop.records:
            array_names.append(self.name())
            self.line(f"{type_of(record.value.dtype)} {array_names[-1]}[{loop.length}];")
        count = self.name()
        conditions = []
        if loop.length is not None:
            conditions.append(f"{count} < {loop.length}")
        if loop.active is not None:
            conditions.append(carry_names[loop.active])
        self.line(f"for (int {count} = 0; {' && '.join(conditions)}; {count}++) {{")
        for element, row in zip(loop.elements, rows, strict=True):
            local_values[element.leaf] = row(count)
        # All that is carried is computed before any of it changes: each may read the others.
        next_names = [self.name() for _ in carry_names]
        with self._inside(loop.body, local_values):
            for record, array_name in zip(loop.records, array_names, strict=True):
                self.line(f"{array_name}[{count}] = {self.get(record.value)};")
            for carry, next_name in zip(loop.carries, next_names, strict=True):
                type_name = type_of(carry.leaf.dtype)
                self.line(f"const {type_name} {next_name} = {self.get(carry.next)};")
        for name, next_name in zip(carry_names, next_names, strict=True):
            self.line(f"{name} = {next_name};")
        self.lines += ["t.sync();", "}"]  # the next round may write what this one reads
        entries = list(carry_names)
        for record, array_name in zip(loop.records, array_names, strict=True):
            entries += [f"{array_name}[{t}]" for t in range(len(record.outs))]
        return entries

    def call(self, call: Call, values: dict[Node, str]) -> Sequence[str]:
        """Writes an operation of the device code."""
        if call.name in _SIMULATIONS:
            self._simulate(call)
        elif call.name in ("layer", "tanh_layer"):
            self._layer(call)
        else:
            return super().call(call, values)
        arrays = enumerate(call.outs)
        return [f"{self._arrays[call, n]}[{k}]" for n, units in arrays for k in range(len(units))]

    def _prepare(self, scalars: Sequence[Scalar]) -> None:
        """Writes the steps, such as a call or a loop, that scalars need and that are not yet."""
        stack = list(scalars)
        nodes = set()
        while stack:
            node = stack.pop()
            if not isinstance(node, Node) or node in nodes or node in self._prepared:
                continue
            nodes.add(node)
            stack += node.args
            if node in self._steps and node not in self._values:
                self._write(self._steps[node])
        self._prepared |= nodes

    def _write(self, step: LiveGate | LiveLoop | Call) -> None:
        """Writes a step of the program, and before it the steps that it needs."""
        # What it reads of its own body is deeper, and is written within it.
        depth = liveness.results(step)[0].scope.depth
        operands = [x for x in liveness.reads([step]) if x.scope.depth <= depth]
        self._prepare(operands)
        if isinstance(step, LiveLoop):  # so that no round of it computes them again
            for node in operands:
                self.value(node, self._values)
        self.run([step], self._values)

    @contextlib.contextmanager
    def _inside(self, body: Schedule, local_values: Mapping[Node, str]) -> Iterator[None]:
        """Within this, what is written is known in the body of a loop or a branch alone."""
        outer_values = self._values
        outer_places = self._written
        self._values = {**outer_values, **local_values}
        self._written = dict(outer_places)
        self._steps |= _owners(body)
        self._depth += 1
        yield
        self._depth -= 1
        self._values = outer_values
        self._written = outer_places
        # A form may name an array of the body, which is not there any more.
        self._formulas.forget()

    @contextlib.contextmanager
    def _once(self, scalars: Sequence[Scalar]) -> Iterator[None]:
        """Within this, lines are for the first run alone if some scalars are constants'."""
        if not self._are_constant(scalars):
            yield
            return
        outer_lines = self.lines
        outer_read = self.read
        self.lines = self.first_lines
        self.read = self.first_read
        with self._inside([], {}):
            # What the runs have computed is not there yet.
            self._values = {}
            self._written = {}
            self._formulas.forget()
            yield
        self.lines = outer_lines
        self.read = outer_read

    def _are_constant(self, scalars: Sequence[Scalar]) -> bool:
        """Returns whether scalars are computed from nothing but constants."""
        leaves = [x for x in ancestors(scalars) if x.op is None]
        return all(x.owner is None and x.position[0] in self._constants for x in leaves)

    def _place(self, scalar: Scalar) -> Place | None:
        """Returns where an argument, a result of a call or an entry of an array is, or None."""
        if is_constant(scalar):
            return None
        if scalar.op is not None or scalar in self._written:
            return self._written.get(scalar)
        if scalar.owner is None:
            number, k = scalar.position
            self.read.add(number)
            return Place(self._inputs(number), k)
        if isinstance(scalar.owner, Call):
            self._prepare([scalar])
            number, k = scalar.position
            return Place(self._arrays[scalar.owner, number], k)
        return None

    def _layer(self, call: Call) -> None:
        """Writes a layer of a network, whose units are the lanes'."""
        x, kernel, bias = map(self.array, call.args)
        (units,) = call.outs
        activations = self._reserve(units[0].dtype, len(units))
        self._arrays[call, 0] = activations
        is_tanh = str(call.name == "tanh_layer").lower()
        sizes = f"{len(call.args[0])}, {len(units)}"
        self.line(f"layer<{is_tanh}>(t, {x}, {kernel}, {bias}, {sizes}, {activations});")
        self.line("t.sync();")

    def _simulate(self, call: Call) -> None:
        """Writes a call of the physics, whose state ``s`` is one for all calls of a program."""
        field_names = [field.rpartition(".")[2] for field in call.fields]
        is_sound = self.name()
        # Of all that the task may read, only this is a result, and not a field of the state.
        sources = {**_STATE, "sound": is_sound}
        for field, scalars in zip(_INPUTS, call.args, strict=False):
            if scalars:
                self.fill(_STATE[field], scalars)
        # Where fields of the model are random, what is drawn of them comes last.
        for scalars in call.args[len(_INPUTS) :]:
            if scalars:
                with self._once(scalars):
                    self.line(f"draw(M, s, {self.array(scalars)}, lane);")
        if self._simulates_once:
            self._read_from(_STATE["ctrl"], call.args[0])  # which the physics leaves as it is
        simulate, meetings = _SIMULATIONS[call.name]
        if self._depth:
            # In a branch or a loop other teams may not come to the meetings.
            team = "t.alone()"
        else:
            team = "t"
            self.meets += meetings.format(self._skip)
        self.lines += ["t.sync();", simulate.format(is_sound, team, self._skip)]
        for result_index, (name, units) in enumerate(zip(field_names, call.outs, strict=True)):
            if units and name not in sources:
                raise UnsupportedPrimitive(f"the task reads {name} of the simulation")
            source = sources.get(name, "")
            if units and not self._simulates_once:  # another operation may overwrite it
                source = self._reserve(units[0].dtype, len(units))
                self.line(f"EACH(i, {len(units)}) {source}[i] = {sources[name]}[i];")
            self._arrays[call, result_index] = source
            if units and name in _OUTPUTS:
                self.reports.append(name.upper())
        self.line("t.sync();")


def _owners(body: Schedule) -> dict[Node, LiveGate | LiveLoop | Call]:
    """Returns the steps of a body by the nodes that stand for their results."""
    return {leaf: x for x in body if not isinstance(x, Node) for leaf in liveness.results(x)}
