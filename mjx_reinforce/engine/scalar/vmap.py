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
from mjx_reinforce.engine.scalar import jaxprs, scalarized
from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.jaxprs import operation
from mjx_reinforce.engine.scalar.nodes import Captured, Node, Op, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop
from mjx_reinforce.engine.scalar.primitives import any_lane

#: XLA takes minutes to compile more operations, and what it makes of them is slow.
MAX_OPERATIONS = 20_000


def vmap(
    fn: Callable, in_axes: PyTree = 0, out_axes: PyTree = 0, branch_cost: int = 32
) -> "Mapped":
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
      ValueError: if no argument is mapped, the mapped sizes differ, or an axis does not fit.
      TooLarge: if fn is more than is written out.
      UnsupportedPrimitive: if fn uses a primitive that has no rule, or reads typed PRNG keys.
    """
    return Mapped(fn, in_axes, out_axes, branch_cost)


class Mapped:
    """What ``vmap`` returns: a function that is written out once for each kind of arguments."""

    def __init__(self, fn: Callable, in_axes: PyTree, out_axes: PyTree, branch_cost: int):
        """Takes the arguments of ``vmap``."""
        functools.update_wrapper(self, fn)
        self._fn = fn
        self._in_axes, self._out_axes = in_axes, out_axes
        self._branch_cost = branch_cost
        self._written: dict[Any, scalarized.Scalarized] = {}

    def __call__(self, *args: PyTree) -> Any:
        """Evaluates the function for every example of a batch."""
        args = jax.tree.map(jnp.asarray, args)
        written, axes = self._write(args)
        count = sum(written.operations.values())
        if count > MAX_OPERATIONS:
            warnings.warn(
                f"written out this function is {count:,} scalar operations, and XLA takes minutes "
                f"to compile more than {MAX_OPERATIONS:,}; use jax.vmap for it",
                stacklevel=2,
            )
        leaves = jax.tree.leaves(args)
        batch = _batch_size(leaves, axes)
        rows = [_rows(leaf, axis) for leaf, axis in zip(leaves, axes, strict=True)]

        def read(place: tuple[int, int]) -> jax.Array:
            return lax.index_in_dim(rows[place[0]], place[1], keepdims=False)

        values = written.compile(XLA(read, (batch,)))
        out_tree = written.out_tree
        target = jax.tree.unflatten(out_tree, range(out_tree.num_leaves))
        ends = _axes(self._out_axes, target)
        outputs = [
            _assemble(scalars, aval, axis, batch)
            for scalars, aval, axis in zip(values, written.out_avals, ends, strict=True)
        ]
        return jax.tree.unflatten(out_tree, outputs)

    def write(self, *args: PyTree) -> scalarized.Scalarized:
        """Returns what is evaluated for these arguments, of which the shapes are enough."""
        return self._write(args)[0]

    def _write(self, args: tuple) -> tuple[scalarized.Scalarized, list[int | None]]:
        """Returns the function written out for these arguments, and the axis of each leaf."""
        leaves, in_tree = jax.tree.flatten(args)
        mapped = [*zip(_axes(self._in_axes, args), leaves, strict=True)]
        axes = [None if axis is None else _axis(axis, leaf.ndim) for axis, leaf in mapped]
        examples = [_example(leaf, axis) for leaf, axis in zip(leaves, axes, strict=True)]
        varying = tuple(axis is not None for axis in axes)
        precision = jnp.result_type(float)  # constants inside depend on it
        key = (in_tree, tuple((x.shape, x.dtype) for x in examples), varying, precision)

        def flat_fn(*flat: PyTree) -> Any:
            return self._fn(*jax.tree.unflatten(in_tree, flat))

        written = self._written.get(key)
        if written is None:  # writing it out takes about a second
            traced = scalarized.trace(flat_fn, *examples)
            written = scalarized.build(*traced, self._branch_cost, varying=varying)
            if not written.captures:
                self._written[key] = written
        return written, axes


def _axes(prefix: PyTree, tree: PyTree) -> list[Any]:
    """Returns the axis of each leaf of the tree, as a pytree prefix says."""
    if isinstance(prefix, list) and isinstance(tree, tuple):
        prefix = tuple(prefix)
    axes: list[Any] = []

    def note(axis: Any, subtree: PyTree) -> None:
        axes.extend([axis] * len(jax.tree.leaves(subtree)))

    jax.tree.map(note, prefix, tree, is_leaf=lambda x: x is None)
    return axes


def _axis(axis: int | None, ndim: int) -> int:
    """Returns a mapped axis counted from the front."""
    if axis is None or not -ndim <= axis < ndim:
        raise ValueError(f"axis {axis} does not exist in an array of {ndim} dimensions")
    return axis % ndim


def _batch_size(leaves: list[jax.Array], axes: list[int | None]) -> int:
    sizes = {x.shape[axis] for x, axis in zip(leaves, axes, strict=True) if axis is not None}
    if len(sizes) != 1:
        raise ValueError(
            f"scalar.vmap needs mapped arguments of one size, got sizes {sorted(sizes)}"
        )
    return sizes.pop()


def _example(x: jax.Array, axis: int | None) -> jax.ShapeDtypeStruct:
    """Returns the shape of one example."""
    shape = tuple(size for i, size in enumerate(x.shape) if i != axis)
    return jax.ShapeDtypeStruct(shape, x.dtype)


def _rows(x: jax.Array, axis: int | None) -> jax.Array:
    """Returns an argument as [elements, batch], or [elements] where lanes share it."""
    if axis is None:
        return x.reshape(-1)
    return jnp.moveaxis(x, axis, -1).reshape(-1, x.shape[axis])


def _assemble(scalars: list[Any], aval: jaxprs.Shape, axis: int | None, batch: int) -> jax.Array:
    """Puts one leaf of the result together."""
    lanes = [x if np.ndim(x) else lax.broadcast(x, (batch,)) for x in scalars]
    stacked = jnp.stack(lanes) if lanes else jnp.zeros((0, batch), aval.dtype)
    shaped = stacked.reshape((*aval.shape, batch))
    return jnp.moveaxis(shaped, -1, _axis(axis, shaped.ndim))


Values = dict[Node, Any]


class XLA(Backend[Any]):
    """Emits JAX operations; a value is a lane, a value that all lanes share, or a constant."""

    def __init__(self, read: Callable[[tuple[int, int]], Any], batch_shape: tuple[int, ...]):
        """Says where the program runs.

        Args:
          read: returns the lane of an input from (number of the argument, position in it).
          batch_shape: the shape of one lane.
        """
        self._read = read
        self._batch_shape = batch_shape

    def constant(self, number: Any) -> Any:
        """A constant stays a NumPy scalar."""
        return number

    def leaf(self, node: Node) -> Any:
        """Reads an input, or an element of a captured array in row-major order."""
        if isinstance(node.owner, Captured):
            array = node.owner.array
            return lax.index_in_dim(
                lax.reshape(array, (array.size,)), node.position, keepdims=False
            )
        return self._read(node.position)

    def node(self, node: Node, operands: list[Any]) -> Any:
        """Emits one operation."""
        op = cast(Op, node.op)  # leaves are not scheduled
        mixes = op.name != "select_n"  # alone in taking no NumPy scalars beside lanes
        values = [
            value if is_constant(arg) and mixes else self._spread(value, node.varying)
            for arg, value in zip(node.args, operands, strict=True)
        ]
        return operation(op.name)(*values, **dict(op.params))

    def gate(self, gate: LiveGate, values: Values) -> Sequence[Any]:
        """Emits a ``cond``."""
        predicate = self._any_of(self.value(gate.predicate, values))
        before = dict(values)
        cold = [self._materialize(out.cold, out.leaf.varying, before) for out in gate.outs]

        def hot() -> list[Any]:
            inner = self.inside(gate.body, values)
            return [self._materialize(out.hot, out.leaf.varying, inner) for out in gate.outs]

        return lax.cond(predicate, hot, lambda: cold)

    def loop(self, loop: LiveLoop, values: Values) -> tuple[list[Any], list[Any]]:
        """Emits a ``fori_loop``, a ``scan`` or a ``while_loop``."""
        init = [self._materialize(c.init, c.out.varying, values) for c in loop.carries]
        body = functools.partial(self._iteration, loop, values)
        if loop.records or loop.elements:
            rows = [
                jax.numpy.stack([self._materialize(x, e.leaf.varying, values) for x in e.values])
                for e in loop.elements
            ]
            final, stacked = lax.scan(body, init, rows, length=loop.length)
            return final, [
                [kept[t] for t in range(len(record.outs))]
                for record, kept in zip(loop.records, stacked, strict=True)
            ]
        return self._repeat(loop, body, init), []

    def _iteration(
        self, loop: LiveLoop, values: Values, carry: list[Any], row: Sequence[Any] = ()
    ) -> tuple[list[Any], list[Any]]:
        """Emits a loop's body; returns the next carry and what is kept."""
        known = dict(zip((c.leaf for c in loop.carries), carry, strict=True))
        known.update(zip((e.leaf for e in loop.elements), row, strict=True))
        inner = self.inside(loop.body, values, known)
        nexts = [self._materialize(c.next, c.out.varying, inner) for c in loop.carries]
        return nexts, [self.value(record.value, inner) for record in loop.records]

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
        return any_lane(predicate) if np.ndim(predicate) else predicate

    def _spread(self, value: Any, varying: bool) -> Any:
        """Gives a constant or a shared value the shape of a lane."""
        if varying and np.shape(value) != self._batch_shape:
            return lax.broadcast(value, self._batch_shape)
        return value

    def _materialize(self, scalar: Scalar, varying: bool, values: Values) -> Any:
        return self._spread(self.value(scalar, values), varying)
