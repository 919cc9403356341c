"""What a scalar graph is made of.

A *scalar* is a NumPy scalar (a constant) or a ``Node`` (a value that each lane of the batch has its
own of, or that all lanes share). The body of a loop and an expensive branch are scopes of their
own: a node placed there is not visible outside.

``OP_TRAITS`` is the one table of the operations, and of how each is computed. JAX computes an
operation on lanes, NumPy computes it on constants. ``simplify`` lists what NumPy has no one
function for, and a backend that does not go through JAX lists what it writes instead.
"""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np


class Op(NamedTuple):
    """An elementwise operation. Equal operations are equal tuples.

    name: a name of ``OP_TRAITS``; mostly that of a JAX primitive.
    params: its parameters by name, sorted; few operations have any.
    """

    name: str
    params: tuple[tuple[str, Hashable], ...] = ()


class OpTraits(NamedTuple):
    """What is known of a name.

    numpy_function: operands -> result; None where NumPy has no one function for it.
    lax_name: the name of a function of ``jax.lax``, (operands, **parameters) -> result; "" where
      that is the name of the operation.
    commutes: whether two operands may change places.
    is_predicate: whether the result is a bool whatever the operands are.
    has_params: whether the parameters of the JAX primitive are part of the operation.
    """

    numpy_function: Callable[..., Any] | None = None
    lax_name: str = ""
    commutes: bool = False
    is_predicate: bool = False
    has_params: bool = False


def _named(*op_names: str, **traits: Any) -> dict[str, OpTraits]:
    """Returns the traits of operations that NumPy has under the same names."""
    return {name: OpTraits(getattr(np, name), **traits) for name in op_names}


#: Every operation that a rule can make.
OP_TRAITS: dict[str, OpTraits] = {
    "add": OpTraits(np.add, commutes=True),
    "mul": OpTraits(np.multiply, commutes=True),
    "max": OpTraits(np.maximum, commutes=True),
    "min": OpTraits(np.minimum, commutes=True),
    "and": OpTraits(np.bitwise_and, lax_name="bitwise_and", commutes=True),
    "or": OpTraits(np.bitwise_or, lax_name="bitwise_or", commutes=True),
    "xor": OpTraits(np.bitwise_xor, lax_name="bitwise_xor", commutes=True),
    "eq": OpTraits(np.equal, is_predicate=True),
    "ne": OpTraits(np.not_equal, is_predicate=True),
    "lt": OpTraits(np.less, is_predicate=True),
    "le": OpTraits(np.less_equal, is_predicate=True),
    "gt": OpTraits(np.greater, is_predicate=True),
    "ge": OpTraits(np.greater_equal, is_predicate=True),
    "is_finite": OpTraits(np.isfinite, is_predicate=True),
    "sub": OpTraits(np.subtract),
    "pow": OpTraits(np.power),
    "atan2": OpTraits(np.arctan2),
    "nextafter": OpTraits(np.nextafter),
    "shift_left": OpTraits(np.left_shift),
    "neg": OpTraits(np.negative),
    "not": OpTraits(np.invert, lax_name="bitwise_not"),
    **_named("abs", "sign", "floor", "ceil", "sqrt", "cbrt", "exp", "exp2", "expm1"),
    **_named("log", "log1p", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    **{f"a{name}": OpTraits(getattr(np, f"arc{name}")) for name in ("sin", "cos", "tan")},
    **{f"a{name}": OpTraits(getattr(np, f"arc{name}")) for name in ("sinh", "cosh", "tanh")},
    **dict.fromkeys(("select_n", "div", "rem", "rsqrt", "logistic"), OpTraits()),
    **dict.fromkeys(("erf", "erf_inv", "erfc", "round"), OpTraits(has_params=True)),
    **dict.fromkeys(("clz", "population_count", "reduce_precision"), OpTraits(has_params=True)),
    **dict.fromkeys(("convert_element_type", "bitcast_convert_type"), OpTraits(has_params=True)),
    **dict.fromkeys(("shift_right_arithmetic", "shift_right_logical"), OpTraits(has_params=True)),
}


SELECT = Op("select_n")


def conversion(dtype: np.dtype) -> Op:
    """Returns the conversion to a dtype."""
    return Op("convert_element_type", (("new_dtype", dtype),))


Scalar = Any  # np.generic or Node


BOOL = np.dtype(bool)


@dataclasses.dataclass(eq=False, slots=True)
class Scope:
    """Where nodes live.

    depth: 0 for the program itself.
    floor: nodes made here are placed in a scope at least this deep.
    nodes: the nodes of this scope by what they compute.
    cost: the number of nodes placed here.
    has_loop: whether a loop was made here.
    """

    depth: int
    floor: int
    nodes: dict[Hashable, "Node"] = dataclasses.field(default_factory=dict)
    cost: int = 0
    has_loop: bool = False


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
    owner: "Loop | Gate | Call | None" = None
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
    is_skippable: whether it is of ``skippable``, and not of a condition.
    """

    scope: Scope
    index: int
    predicate: Node
    body: Scope
    hot: list[Scalar]
    cold: list[Scalar]
    outs: list[Node | None] = dataclasses.field(default_factory=list)
    is_skippable: bool = False


@dataclasses.dataclass(eq=False, slots=True)
class Call:
    """An operation on arrays that stays whole, for backends that know it by name.

    scope: where the call is.
    index: its place among the nodes of that scope.
    name: of the operation.
    args: the scalars of each operand.
    fields: the name of each result.
    outs: the leaves that stand for the elements of each result; none where nothing reads it.
    """

    scope: Scope
    index: int
    name: str
    args: list[list[Scalar]]
    fields: tuple[str, ...]
    outs: list[list[Node]] = dataclasses.field(default_factory=list)


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
        runs_at_least_once = self.active is None and bool(self.length)
        carry = []
        for init, following, out in zip(self.inits, self.nexts, self.outs, strict=True):
            is_inside = isinstance(following, Node) and following.scope is self.body
            if out is None:
                carry.append(init)
            elif is_inside or not runs_at_least_once:
                carry.append(out)
            else:
                carry.append(following)
        # What every iteration adds alike has no leaves: it is the same scalar each time.
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


def same(x: Scalar, y: Scalar) -> bool:
    """Returns whether two scalars are the same node or bitwise the same constant."""
    return x is y or identity(x) == identity(y)
