"""``vmap``: a drop-in for ``jax.vmap`` that leaves only elementwise work.

``XLA`` turns the scalar graph back into JAX: one elementwise operation for each node.
"""

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.jaxprs import operation
from mjx_reinforce.engine.scalar.nodes import Node, Op, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop
from mjx_reinforce.engine.scalar.primitives import any_lane

#: XLA takes minutes to compile more operations, and what it makes of them is slow.
MAX_OPERATIONS = 20_000


def vmap(
    fn: Callable, in_axes: PyTree = 0, out_axes: PyTree = 0, branch_cost: int = 32
) -> Callable[..., Any]:
    """Maps a function over a batch, like ``jax.vmap``, one array over the batch for each scalar.

    The function is traced for one example and evaluated element by element; see the package's
    docstring for what that costs and which floating-point promises it loosens. Call the result
    under ``jax.jit``. The fastest layout keeps the batch last (axes of -1): then each scalar's lane
    is one contiguous row.

    Args:
      fn: a function of one example; pytrees in and out.
      in_axes: for each argument an axis, None for one that all lanes share, or a pytree prefix.
      out_axes: an axis for each part of the result.
      branch_cost: a branch of ``cond`` with more scalar operations than this, or with a loop, is
        skipped where no lane needs it; others are computed for every lane. XLA's CPU backend
        computes shared values again in each fusion, and a real branch also stops that.

    Returns:
      The mapped function, of positional arguments.

    Raises:
      ValueError: where ``jax.vmap`` raises it.
      TooLarge: if fn is more than is written out.
      UnsupportedPrimitive: if fn uses a primitive that has no rule, or reads typed PRNG keys.
    """
    example_fn = jax.custom_batching.custom_vmap(lambda *args: fn(*args))

    @example_fn.def_vmap
    def _(batch, axes, *args):
        """Returns the results of a batch, and that the batch is the first axis of each."""
        varying = jax.tree.leaves(axes)
        leaves, tree = jax.tree.flatten(args)
        examples = [
            jax.ShapeDtypeStruct(jnp.shape(x)[is_varying:], jnp.result_type(x))
            for x, is_varying in zip(leaves, varying, strict=True)
        ]
        program = scalarized.trace(fn, *tree.unflatten(examples))
        expansion = scalarized.build(*program, branch_cost, varying=varying)
        return evaluate(expansion, leaves, varying), jax.tree.map(lambda _: True, program[1])

    return functools.wraps(fn)(jax.vmap(example_fn, in_axes, out_axes))


def evaluate(program: scalarized.Scalarized, leaves: Sequence[Any], varying: Sequence[bool]) -> Any:
    """Evaluates a function for every example of a batch, the first axis of all results.

    Args:
      program: the function.
      leaves: of its arguments.
      varying: whether the first axis of each is the batch; one at least is so.
    """
    count = sum(program.operations.values())
    if count > MAX_OPERATIONS:
        warnings.warn(
            f"written out this function is {count:,} scalar operations, and XLA takes minutes "
            f"to compile more than {MAX_OPERATIONS:,}; use jax.vmap for it",
            stacklevel=2,
        )
    batch = leaves[list(varying).index(True)].shape[0]
    # [entries, N] of an argument that varies, so that a scalar's lane is a contiguous row.
    rows = [
        jnp.moveaxis(x, 0, -1).reshape(-1, batch) if is_varying else jnp.reshape(x, -1)
        for x, is_varying in zip(leaves, varying, strict=True)
    ]
    rows += [x.reshape(-1) for x in program.captured]

    def read(place: tuple[int, int]) -> jax.Array:
        return lax.index_in_dim(rows[place[0]], place[1], keepdims=False)

    outputs = []
    values = program.compile(XLA(read, (batch,)))
    for scalars, aval in zip(values, program.out_avals, strict=True):
        lanes = [x if np.ndim(x) else lax.broadcast(x, (batch,)) for x in scalars]
        # [entries, N] here, and the batch comes first in the result, as ``jax.vmap`` wants it.
        batch_leaf = jnp.stack(lanes) if lanes else jnp.zeros((0, batch), aval.dtype)
        outputs.append(jnp.moveaxis(batch_leaf.reshape((*aval.shape, batch)), -1, 0))
    return jax.tree.unflatten(program.out_tree, outputs)


Values = dict[Node, Any]


class XLA(Backend[Any]):
    """Emits JAX operations; a value is a lane, a value that all lanes share, or a constant."""

    def __init__(self, read_input: Callable[[tuple[int, int]], Any], batch_shape: tuple[int, ...]):
        """Says where the program runs.

        Args:
          read_input: returns the lane of an input from (number of the argument, position in it).
          batch_shape: the shape of one lane.
        """
        self._read = read_input
        self._batch_shape = batch_shape

    def constant(self, number: Any) -> Any:
        """A constant stays a NumPy scalar."""
        return number

    def leaf(self, node: Node) -> Any:
        """Reads an input."""
        return self._read(node.position)

    def node(self, node: Node, operands: list[Any]) -> Any:
        """Emits one operation."""
        op = cast(Op, node.op)  # leaves are not scheduled
        is_mixed = op.name != "select_n"  # alone in taking no NumPy scalars beside lanes
        values = [
            value if is_constant(arg) and is_mixed else self._spread(value, node.varying)
            for arg, value in zip(node.args, operands, strict=True)
        ]
        return operation(op.name)(*values, **dict(op.params))

    def gate(self, gate: LiveGate, values: Values) -> Sequence[Any]:
        """Emits a ``cond``."""
        predicate = self._any_of(self.value(gate.predicate, values))
        # Reading a leaf adds it to the values. With a copy, the branch reads its own and captures
        # none of these.
        scope = dict(values)
        cold_values = [self._materialize(out.cold, out.leaf.varying, scope) for out in gate.outs]

        def hot() -> list[Any]:
            inner_values = self.inside(gate.body, values)
            return [self._materialize(out.hot, out.leaf.varying, inner_values) for out in gate.outs]

        return lax.cond(predicate, hot, lambda: cold_values)

    def loop(self, loop: LiveLoop, values: Values) -> list[Any]:
        """Emits a ``fori_loop``, a ``scan`` or a ``while_loop``."""
        init = [self._materialize(c.init, c.out.varying, values) for c in loop.carries]
        body = functools.partial(self._iteration, loop, values)
        # Only ``scan`` reads a row and keeps a record in each iteration; such a loop has a length
        # and never ends early.
        if loop.records or loop.elements:
            rows = [
                jax.numpy.stack([self._materialize(x, e.leaf.varying, values) for x in e.values])
                for e in loop.elements
            ]
            state, stacks = lax.scan(body, init, rows, length=loop.length)
            records = zip(loop.records, stacks, strict=True)
            return [*state, *(row[t] for record, row in records for t in range(len(record.outs)))]
        return self._repeat(loop, body, init)

    def _iteration(
        self, loop: LiveLoop, values: Values, carry: list[Any], row: Sequence[Any] = ()
    ) -> tuple[list[Any], list[Any]]:
        """Emits a loop's body; returns the next carry and what is kept."""
        leaves = dict(zip((c.leaf for c in loop.carries), carry, strict=True))
        leaves.update(zip((e.leaf for e in loop.elements), row, strict=True))
        inner_values = self.inside(loop.body, values, leaves)
        next_values = [self._materialize(c.next, c.out.varying, inner_values) for c in loop.carries]
        return next_values, [self.value(record.value, inner_values) for record in loop.records]

    def _repeat(self, loop: LiveLoop, body: Callable, init: list[Any]) -> list[Any]:
        """Emits a loop that reads no elements and keeps no records."""
        if loop.active is None:
            return lax.fori_loop(0, loop.length, lambda _, carry: body(carry)[0], init)
        switch = loop.active
        if loop.length is None:
            return lax.while_loop(
                lambda carry: self._any_of(carry[switch]), lambda carry: body(carry)[0], init
            )

        def goes_on(state: tuple[Any, list]) -> Any:
            count, carry = state
            return (count < loop.length) & self._any_of(carry[switch])

        start = (np.int32(0), init)
        step = lambda state: (state[0] + 1, body(state[1])[0])  # noqa: E731
        return lax.while_loop(goes_on, step, start)[1]

    def _any_of(self, predicate: Any) -> Any:
        """Returns whether a predicate holds in any lane; one that all lanes share is the answer."""
        if np.ndim(predicate) == 0:
            return predicate
        return any_lane(predicate)

    def _spread(self, value: Any, varying: bool) -> Any:
        """Gives a constant or a shared value the shape of a lane."""
        if varying and np.shape(value) != self._batch_shape:
            return lax.broadcast(value, self._batch_shape)
        return value

    def _materialize(self, scalar: Scalar, varying: bool, values: Values) -> Any:
        return self._spread(self.value(scalar, values), varying)
