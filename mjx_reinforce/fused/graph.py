"""The scalar graph: what a program becomes before it is JAX again.

A *scalar* is a NumPy scalar (a constant) or a `Node` (a value that each lane of the batch has its
own of, or that all lanes share). Equal nodes are one object, so common subexpressions are shared.

Values have scopes. The body of a loop and an expensive branch are scopes of their own: a node made
there is not visible outside. A node that needs nothing of a loop's body is placed before the loop;
out of a branch nothing moves, because a branch exists to be skipped.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax import lax

from mjx_reinforce.fused import arrays, jaxprs, ops, simplify

Scalar = Any  # np.generic or Node


@dataclasses.dataclass(eq=False, slots=True)
class Scope:
    """Where nodes live.

    Attributes:
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


@dataclasses.dataclass(eq=False, slots=True)
class Node:
    """One value.

    Attributes:
        dtype: its dtype.
        varying: True if each lane has its own, False if all lanes share it.
        scope: where it can be used.
        index: nodes are numbered as they are made, so operands come before results.
        op: what computes it; None for a leaf.
        args: the operands.
        owner: the loop or gate that a leaf belongs to; None for an input.
        position: which of the owner's values a leaf is.
    """

    dtype: np.dtype
    varying: bool
    scope: Scope
    index: int
    op: ops.Op | None = None
    args: tuple[Scalar, ...] = ()
    owner: Any = None
    position: Any = None


class Captured(NamedTuple):
    """An array that the program closes over and whose value is not known yet.

    Attributes:
        array: a tracer of an outer transformation.
    """

    array: Any

    def element(self, position: int) -> Any:
        """Returns one element, in row-major order."""
        flat = lax.reshape(self.array, (self.array.size,))
        return lax.index_in_dim(flat, position, keepdims=False)


class Graph:
    """Makes nodes, folding constants and sharing equal ones.

    Attributes:
        branch_cost: a branch of more scalar operations than this is skipped where no lane needs it.
        unrolled: a scan that reads and makes no arrays is written out up to this length.
        certain: predicates known to hold in some lane, because we are where nothing runs otherwise.
    """

    def __init__(self, branch_cost: int, unrolled: int):
        self.branch_cost = branch_cost
        self.unrolled = unrolled
        self.certain: set[Node] = set()
        self._scopes = [Scope(depth=0, floor=0)]
        self._count = 0
        self._captured: dict[int, tuple[Captured, np.ndarray]] = {}

    @property
    def scope(self) -> Scope:
        """The innermost scope."""
        return self._scopes[-1]

    @property
    def captures(self) -> bool:
        """Whether the program closes over an array whose value is not known yet."""
        return bool(self._captured)

    @contextlib.contextmanager
    def loop_body(self) -> Iterator[Scope]:
        """Opens a scope that invariant nodes leave."""
        with self._open(self.scope.floor) as scope:
            yield scope

    @contextlib.contextmanager
    def branch(self) -> Iterator[Scope]:
        """Opens a scope that nothing leaves."""
        with self._open(self.scope.depth + 1) as scope:
            yield scope

    @contextlib.contextmanager
    def _open(self, floor: int) -> Iterator[Scope]:
        scope = Scope(depth=self.scope.depth + 1, floor=floor)
        self._scopes.append(scope)
        try:
            yield scope
        finally:
            self._scopes.pop()
            self.scope.cost += scope.cost
            self.scope.has_loop |= scope.has_loop

    def leaf(self, dtype: Any, varying: bool, owner: Any = None, position: Any = None) -> Node:
        """Makes a node that nothing computes: an input, a loop's carry, a gate's result."""
        index = self.number()
        return Node(np.dtype(dtype), varying, self.scope, index, owner=owner, position=position)

    def constant(self, value: Any) -> np.ndarray:
        """Returns a captured array: its value, or shared leaves if it is a tracer."""
        known = jaxprs.as_numpy(value)
        if known is not None:
            return known
        if id(value) not in self._captured:
            source = Captured(value)
            leaves = [
                Node(value.dtype, False, self._scopes[0], self.number(), owner=source, position=i)
                for i in range(value.size)
            ]
            self._captured[id(value)] = (source, arrays.pack(leaves, value.shape, value.dtype))
        return self._captured[id(value)][1]

    def number(self) -> int:
        """Returns the next index."""
        self._count += 1
        return self._count

    def call(self, name: str, *args: Scalar) -> Scalar:
        """Applies one of the named operations to scalars."""
        op = ops.CORE[name]
        return self.apply(op, args, np.dtype(bool) if op.is_predicate else args[-1].dtype)

    def convert(self, value: Scalar, dtype: Any) -> Scalar:
        """Converts a scalar to another dtype."""
        dtype = np.dtype(dtype)
        return self.apply(ops.conversion(dtype), (value,), dtype)

    def select(self, predicate: Scalar, on_true: Scalar, on_false: Scalar) -> Scalar:
        """Returns on_true where the predicate holds, else on_false."""
        return self.apply(ops.SELECT, (predicate, on_false, on_true), on_true.dtype)

    def fold(self, function: Callable, values: Sequence[Scalar], first: Scalar) -> Scalar:
        """Combines values from the left."""
        for value in values:
            first = function(first, value)
        return first

    def apply(self, op: ops.Op, args: tuple[Scalar, ...], dtype: np.dtype) -> Scalar:
        """Applies an operation: a constant, an existing node, a simpler one or a new one."""
        if not any(isinstance(arg, Node) for arg in args):
            return ops.fold(op, args, dtype)
        simpler = simplify.simplify(self, op, args, dtype)
        return self._share(op, args, dtype) if simpler is None else simpler

    def _share(self, op: ops.Op, args: tuple[Scalar, ...], dtype: np.dtype) -> Node:
        keys = tuple(map(identity, args))
        key = (op.key, tuple(sorted(keys)) if op.commutes else keys)
        nodes = [arg for arg in args if isinstance(arg, Node)]
        depth = max(self.scope.floor, *(node.scope.depth for node in nodes))
        for scope in self._scopes[depth::-1]:
            if key in scope.known:
                return scope.known[key]
        scope = self._scopes[depth]
        varying = any(node.varying for node in nodes)
        node = Node(dtype, varying, scope, self.number(), op=op, args=args)
        scope.known[key] = node
        scope.cost += 1
        return node


def identity(value: Scalar) -> tuple:
    """Returns what tells a scalar from others: bits for a constant, so that NaN equals itself."""
    if isinstance(value, Node):
        return (0, value.index, "")
    return (1, value.tobytes(), value.dtype.str)


def same(left: Scalar, right: Scalar) -> bool:
    """Tells whether two scalars are the same node or bitwise the same constant."""
    return left is right or identity(left) == identity(right)
