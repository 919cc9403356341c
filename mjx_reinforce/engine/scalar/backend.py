"""What all backends share: the walk through a schedule."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive
from mjx_reinforce.engine.scalar.nodes import Call, Node, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule, results

#: What a backend makes of a scalar: a lane, the name of a variable, ...
Value = TypeVar("Value")


class Backend(abc.ABC, Generic[Value]):
    """Makes something of a scalar graph, step by step.

    An *environment* has the value of each node that is known so far. What a loop's body or a
    branch computes is known only inside, so it is run in an environment of its own (``inside``).

    OPERATIONS: what the backend makes of each operation, by name, with an entry for every
      name of ``nodes.OP_TRAITS``; None for a backend without a table of its own.
    """

    OPERATIONS: ClassVar[Mapping[str, Any] | None] = None

    @abc.abstractmethod
    def constant(self, number: Any) -> Value:
        """Returns what a NumPy scalar becomes."""

    @abc.abstractmethod
    def leaf(self, node: Node) -> Value:
        """Returns what an input becomes, or an element of a captured array.

        It is called when the value is first needed.
        """

    @abc.abstractmethod
    def node(self, node: Node, operands: list[Value]) -> Value:
        """Returns what the operation of a node becomes."""

    @abc.abstractmethod
    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Returns a value for each of the gate's outs."""

    @abc.abstractmethod
    def loop(self, loop: LiveLoop, values: dict[Node, Value]) -> Sequence[Value]:
        """Returns the final value of each carry, then each record's in each iteration."""

    def call(self, call: Call, values: dict[Node, Value]) -> Sequence[Value]:
        """Returns the value of each element of each result of an operation that stays whole."""
        raise UnsupportedPrimitive(f"it has no operation {call.name!r}")

    def compile(self, schedule: Schedule, outputs: list[list[Scalar]]) -> list[list[Value]]:
        """Runs a whole program; returns the value of each element of each output."""
        values: dict[Node, Value] = {}
        self.run(schedule, values)
        return [[self.value(x, values) for x in leaf] for leaf in outputs]

    def run(self, schedule: Schedule, values: dict[Node, Value]) -> None:
        """Adds to the values what the steps of a schedule compute."""
        for step in schedule:
            if isinstance(step, Node):
                values[step] = self.node(step, [self.value(arg, values) for arg in step.args])
                continue
            # Each of these gives a value to every node that stands for one of its results.
            if isinstance(step, LiveLoop):
                step_values = self.loop(step, values)
            elif isinstance(step, Call):
                step_values = self.call(step, values)
            else:
                step_values = self.gate(step, values)
            values.update(zip(results(step), step_values, strict=True))

    def inside(
        self, body: Schedule, values: dict[Node, Value], leaves: Mapping[Node, Value] | None = None
    ) -> dict[Node, Value]:
        """Runs the body of a loop or a gate; returns the values at its end.

        Args:
          body: its steps.
          values: the values known around it, left as they are.
          leaves: the values of the leaves that the body starts from.
        """
        # A copy: what the body computes is unknown around it, where it may not have run.
        inner_values = {**values, **(leaves or {})}
        self.run(body, inner_values)
        return inner_values

    def value(self, scalar: Scalar, values: dict[Node, Value]) -> Value:
        """Returns a scalar's value, reading leaves when they are first needed."""
        if is_constant(scalar):
            return self.constant(scalar)
        if scalar not in values:
            values[scalar] = self.leaf(scalar)
        return values[scalar]
