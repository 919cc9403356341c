"""What a scalar graph is made of.

A *scalar* is a NumPy scalar (a constant) or a ``Node`` (a value that each lane of the batch has its
own of, or that all lanes share). The body of a loop and an expensive branch are scopes of their
own: a node placed there is not visible outside.
"""

import dataclasses
from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.scalar.ops import Op

Scalar = Any  # np.generic or Node

BOOL = np.dtype(bool)


@dataclasses.dataclass(eq=False, slots=True)
class Scope:
    """Where nodes live.

    depth: 0 for the program itself.
    floor: nodes made here are placed in a scope at least this deep.
    known: the nodes of this scope by what they compute.
    cost: the number of nodes placed here.
    has_loop: whether a loop was made here.
    """

    depth: int
    floor: int
    known: dict[Hashable, "Node"] = dataclasses.field(default_factory=dict)
    cost: int = 0
    has_loop: bool = False


class Captured(NamedTuple):
    """An array that the program closes over and whose value is not known yet.

    array: a tracer of an outer transformation.
    """

    array: Any


@dataclasses.dataclass(eq=False, slots=True)
class Node:
    """One value.

    dtype: its dtype.
    varying: True if each lane has its own, False if all lanes share it.
    scope: where it can be used.
    index: nodes are numbered as they are made, so operands come before results.
    op: what computes it; None for a leaf.
    args: the operands.
    owner: what a leaf belongs to; None for an input of the program.
    position: which of the owner's values a leaf is; for an input (argument, element).
    """

    dtype: np.dtype
    varying: bool
    scope: Scope
    index: int
    op: Op | None = None
    args: tuple[Scalar, ...] = ()
    owner: "Loop | Gate | Captured | None" = None
    position: Any = None


@dataclasses.dataclass(eq=False, slots=True)
class Gate:
    """A branch that runs only if some lane needs it.

    scope: where the gate is.
    index: its place among the nodes of that scope.
    predicate: which lanes need the branch.
    body: the scope of the branch.
    hot: the results if some lane needs it, each lane's own already selected.
    cold: the results if none does.
    outs: the leaf that stands for each result; None where hot and cold are the same.
    """

    scope: Scope
    index: int
    predicate: Node
    body: Scope
    hot: list[Scalar]
    cold: list[Scalar]
    outs: list[Node | None] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(eq=False, slots=True)
class Loop:
    """A loop over scalars.

    scope: where the loop runs.
    index: its place among the nodes of that scope.
    length: the number of iterations, or None for no limit.
    inits: what the carry starts from.
    active: the position in the carry of the bool that ends the loop when no lane has it.
    xs: for each element, its value in each iteration.
    body: the scope of one iteration.
    carries: the leaf that stands for each carry; None where the carry never changes.
    elements: the leaf that stands for each of xs; None where it is the same throughout.
    nexts: the carry after one iteration.
    ys: what each iteration adds to the results.
    outs: the leaf that stands for each final carry.
    stacked: the leaf that stands for each of ys in each iteration.
    """

    scope: Scope
    index: int
    length: int | None
    inits: list[Scalar]
    active: int | None
    xs: list[list[Scalar]]
    body: Scope
    carries: list[Node | None] = dataclasses.field(default_factory=list)
    elements: list[Node | None] = dataclasses.field(default_factory=list)
    nexts: list[Scalar] = dataclasses.field(default_factory=list)
    ys: list[Scalar] = dataclasses.field(default_factory=list)
    outs: list[Node | None] = dataclasses.field(default_factory=list)
    stacked: list[list[Node]] = dataclasses.field(default_factory=list)

    def results(self) -> tuple[list[Scalar], list[list[Scalar]]]:
        """Returns the final carry, and each of ys in each iteration.

        A carry that every iteration sets to the same is that, and not what the loop ends with.
        """
        certain = self.active is None and bool(self.length)  # that an iteration runs
        carry = []
        for init, following, out in zip(self.inits, self.nexts, self.outs, strict=True):
            inside = isinstance(following, Node) and following.scope is self.body
            carry.append(init if out is None else out if inside or not certain else following)
        ys = [
            stacked or [y] * (self.length or 0)
            for y, stacked in zip(self.ys, self.stacked, strict=True)
        ]
        return carry, ys


def is_constant(scalar: Scalar) -> bool:
    """Returns whether a scalar is a constant."""
    return isinstance(scalar, np.generic)


def identity(scalar: Scalar) -> tuple:
    """Returns what tells a scalar from others: bits for a constant, so that NaN equals itself."""
    if isinstance(scalar, Node):
        return (0, scalar.index, "")
    return (1, scalar.tobytes(), scalar.dtype.str)


def same(left: Scalar, right: Scalar) -> bool:
    """Returns whether two scalars are the same node or bitwise the same constant."""
    return left is right or identity(left) == identity(right)
