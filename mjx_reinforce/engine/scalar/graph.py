"""The scalar graph: a program as elementwise operations on scalars.

``nodes`` has the parts; here they are made. Equal nodes are one object, so common subexpressions
are shared. A node that needs nothing of a loop's body is placed before the loop. Nothing is moved
out of a branch, because then it would run also where the branch is skipped.
"""

from collections.abc import Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.scalar import jaxprs, nodes
from mjx_reinforce.engine.scalar.nodes import Node, Op, Scalar, Scope
from mjx_reinforce.engine.scalar.passes import simplify
from mjx_reinforce.engine.scalar.size import MAX_SCALARS, TooLarge

#: ``size`` foresees what is written; where it errs, writing ends here.
_MAX_NODES = 3 * MAX_SCALARS


class Graph:
    """Makes nodes, folding constants and sharing equal ones.

    branch_cost: a branch of more scalar operations than this is skipped where no element of
      the batch needs it.
    scans: up to which length scans are written out. Constants fold iteration by iteration in a scan
      that is written out, and a loop is shorter. A scan whose own ``unroll`` is its whole length is
      always written out, as JAX does.
    path: the equations that are being evaluated, from the outermost one, by their ids.
    findings: what was found out on a path. The body of a loop is evaluated again and again, each
      time with less assumed of what never changes, and what was found out inside still holds.
    premises: predicates of the branches and loops around the present scope. Its code runs only
      if each of them is true for at least one element of the batch.
    """

    def __init__(self, branch_cost: int, scans: int):
        """Starts a graph without nodes, in the scope of the program itself."""
        self.branch_cost = branch_cost
        self.scans = scans
        self.path: tuple[int, ...] = ()
        self.findings: dict[Hashable, Any] = {}
        # The equations of all paths so far. Python would give the id of a dropped one to another.
        self._equations: dict[int, Any] = {}
        self.premises: set[Node] = set()
        self._scopes = [Scope(depth=0, floor=0)]
        self._num_numbered = 0
        self._num_applied = 0

    @property
    def scope(self) -> Scope:
        """The innermost scope."""
        return self._scopes[-1]

    @contextmanager
    def evaluating(self, eqn: jaxprs.Equation) -> Iterator[None]:
        """Lengthens the path by an equation."""
        self._equations[id(eqn)] = eqn
        outer_path = self.path
        self.path = (*outer_path, id(eqn))
        try:
            yield
        finally:
            self.path = outer_path

    def source(self, eqn: jaxprs.Equation) -> str:
        """Returns the user's line that an equation is from, or else the innermost call around it.

        Inside of a jitted function of JAX no line is the user's.
        """
        innermost_first = [eqn, *(self._equations[index] for index in reversed(self.path))]
        return next(filter(None, map(jaxprs.source, innermost_first)), "an unknown line")

    def loop_body(self) -> AbstractContextManager[Scope]:
        """Opens the scope of a loop's body; nodes that do not depend on it are placed outside."""
        return self._open(self.scope.floor)

    def branch(self) -> AbstractContextManager[Scope]:
        """Opens the scope of a branch; everything made in it stays in it."""
        return self._open(self.scope.depth + 1)

    @contextmanager
    def _open(self, floor: int) -> Iterator[Scope]:
        """Opens a scope whose nodes are placed in one at least as deep as ``floor``."""
        scope = Scope(depth=self.scope.depth + 1, floor=floor)
        self._scopes.append(scope)
        try:
            yield scope
        finally:
            self._scopes.pop()
            # A branch around this scope costs what is inside of it, too.
            self.scope.cost += scope.cost
            self.scope.has_loop |= scope.has_loop

    @contextmanager
    def again(self, scope: Scope) -> Iterator[None]:
        """Opens the scope of a branch once more; it is still the innermost's child."""
        cost_before = scope.cost
        self._scopes.append(scope)
        try:
            yield
        finally:
            self._scopes.pop()
            # Its cost up to here was added when it was opened for the first time.
            self.scope.cost += scope.cost - cost_before

    @contextmanager
    def assuming(self, predicate: Scalar) -> Iterator[None]:
        """Assumes in a block that a predicate is true for at least one element of the batch."""
        outer_premises = set(self.premises)
        if isinstance(predicate, Node):
            self.premises.add(predicate)
        try:
            yield
        finally:
            self.premises = outer_premises

    def leaf(
        self, dtype: DTypeLike, varying: bool, owner: Any = None, position: Any = None
    ) -> Node:
        """Makes a node that nothing computes: an input, a loop's carry, a gate's result."""
        index = self.number()
        return Node(np.dtype(dtype), varying, self.scope, index, owner=owner, position=position)

    def number(self) -> int:
        """Returns the next index."""
        self._num_numbered += 1
        return self._num_numbered

    def call(self, name: str, *args: Scalar) -> Scalar:
        """Applies one of the named operations to scalars."""
        # The last operand has the dtype of the result: of a selection the first is a predicate.
        dtype = args[-1].dtype
        if nodes.OP_TRAITS[name].is_predicate:
            dtype = nodes.BOOL
        return self.apply(Op(name), args, dtype)

    def convert(self, value: Scalar, dtype: DTypeLike) -> Scalar:
        """Converts a scalar to another dtype."""
        dtype = np.dtype(dtype)
        return self.apply(nodes.conversion(dtype), (value,), dtype)

    def select(self, predicate: Scalar, on_true: Scalar, on_false: Scalar) -> Scalar:
        """Returns on_true where the predicate holds, else on_false."""
        return self.apply(nodes.SELECT, (predicate, on_false, on_true), on_true.dtype)

    def apply(self, op: Op, args: tuple[Scalar, ...], dtype: np.dtype) -> Scalar:
        """Applies an operation: a constant, an existing node, a simpler one or a new one."""
        operands = [arg for arg in args if isinstance(arg, Node)]
        if not operands:
            return simplify.fold(op, args, dtype)
        # Every request counts, also one that an existing node answers: it takes its time.
        self._num_applied += 1
        if self._num_applied > _MAX_NODES:
            raise TooLarge(f"written out it is more than {_MAX_NODES:,} scalar operations")
        simple_form = simplify.simplify(self, op, args, dtype)
        if simple_form is not None:
            return simple_form
        return self._share(op, args, operands, dtype)

    def _share(
        self, op: Op, args: tuple[Scalar, ...], operands: list[Node], dtype: np.dtype
    ) -> Node:
        """Returns the node of an operation, a new one only if there is none.

        Args:
          op: the operation.
          args: its operands.
          operands: those of them that are nodes, at least one.
          dtype: that of the result.
        """
        identities = [arg if isinstance(arg, Node) else nodes.identity(arg) for arg in args]
        commutes = nodes.OP_TRAITS[op.name].commutes
        key = (op, frozenset(identities) if commutes else tuple(identities))
        # No node of these operands can be further outside than the innermost of them.
        outermost = max([node.scope.depth for node in operands])
        depth = max(self.scope.floor, outermost)
        for k in range(depth, outermost - 1, -1):
            equal_node = self._scopes[k].nodes.get(key)
            if equal_node is not None:
                return equal_node
        scope = self._scopes[depth]
        varying = any(node.varying for node in operands)
        node = Node(dtype, varying, scope, self.number(), op=op, args=args)
        scope.nodes[key] = node
        scope.cost += 1
        return node
