"""`scalarize`: a function of one example, written out in scalars."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax import lax

from mjx_reinforce.fused import arrays, evaluate, jaxprs, lanes, liveness, loops
from mjx_reinforce.fused.backends import BACKENDS
from mjx_reinforce.fused.graph import Graph
from mjx_reinforce.fused.nodes import Scalar, is_constant
from mjx_reinforce.registry import check_name, load


@dataclasses.dataclass(frozen=True)
class Scalarized:
    """A function written out in scalars.

    Attributes:
        in_tree: the structure of its arguments.
        in_avals: shape and dtype of each leaf of the arguments.
        out_tree: the structure of its result.
        out_avals: shape and dtype of each leaf of the result.
        outputs: the scalars of each leaf of the result.
        schedule: the steps that compute them.
        captures: whether it closes over an array that an outer transformation traces.
    """

    in_tree: Any
    in_avals: list[Any]
    out_tree: Any
    out_avals: list[Any]
    outputs: list[list[Scalar]]
    schedule: liveness.Schedule
    captures: bool

    def compile(self, backend: str, **settings: Any) -> Any:
        """Returns what a backend makes of the function.

        Args:
            backend: a name of `backends.BACKENDS`.
            **settings: what the backend takes.
        """
        check_name("backend", backend, BACKENDS)
        return load(BACKENDS[backend])(**settings).compile(self.schedule, self.outputs)

    @property
    def operations(self) -> Counter:
        """How many scalar operations it takes, by name; a loop's body counts once."""
        return self.compile("count")

    def emit(
        self,
        read: Callable[[tuple[int, int]], Any],
        batch_shape: tuple[int, ...],
        any_lane: Callable,
    ) -> list[list[Any]]:
        """Emits the operations.

        Args:
            read: returns the lane of an argument from (number of the leaf, row-major position).
            batch_shape: the shape of one lane.
            any_lane: reduces a lane of bools to one bool.

        Returns:
            For each leaf of the result, its elements: lanes, shared values and constants.
        """
        return self.compile("xla", read=read, batch_shape=batch_shape, any_lane=any_lane)

    def __call__(self, *args: Any, any_lane: Callable = lanes.any_lane) -> Any:
        """Evaluates the function on lanes.

        Args:
            *args: like the examples, but each leaf is an object array or a nested list of lanes.
            any_lane: reduces a lane of bools to one bool.

        Returns:
            The result, each leaf an object array of lanes.
        """
        leaves = [
            _lanes(leaf, aval.shape)
            for leaf, aval in zip(self.in_tree.flatten_up_to(args), self.in_avals, strict=True)
        ]
        batch_shape = np.broadcast_shapes(*(np.shape(lane) for leaf in leaves for lane in leaf))

        def read(position: tuple[int, int]) -> Any:
            return full(leaves[position[0]][position[1]], batch_shape)

        results = []
        values = self.emit(read, batch_shape, any_lane)
        for scalars, aval in zip(values, self.out_avals, strict=True):
            filled = (full(scalar, batch_shape) for scalar in scalars)
            results.append(np.fromiter(filled, object, len(scalars)).reshape(aval.shape))
        return jax.tree.unflatten(self.out_tree, results)


def scalarize(fn: Callable, *examples: Any, branch_cost: int = 400) -> Scalarized:
    """Writes a function out in scalars, to be evaluated on lanes in any memory.

    What comes back emits only elementwise operations, loops and branches, and constants only as
    NumPy scalars.

    Args:
        fn: a function of one example.
        *examples: its arguments, or their `jax.ShapeDtypeStruct`s.
        branch_cost: a branch of `cond` with more operations than this, or with a loop, is skipped
            where no lane needs it; others are computed for every lane.
    """
    return build(fn, examples, [True] * len(jax.tree.leaves(examples)), branch_cost)


def build(
    fn: Callable,
    examples: Sequence[Any],
    varying: Sequence[bool],
    branch_cost: int,
    unrolled: int = loops.UNROLLED_LENGTH,
    unrolled_arrays: int = loops.UNROLLED_LENGTH,
    unrolled_on_request: int = loops.UNROLLED_LENGTH,
) -> Scalarized:
    """Writes a function out.

    Args:
        fn: a function of one example.
        examples: its arguments, or their shapes.
        varying: which of their leaves differ from lane to lane.
        branch_cost: as in `scalarize`.
        unrolled: a scan that reads and makes no arrays is written out up to this length.
        unrolled_arrays: one that reads or makes arrays is written out up to this length.
        unrolled_on_request: one whose `unroll` is more than 1 is, up to this length.
    """
    program, out_shape = jaxprs.trace(fn, *examples)
    in_tree = jax.tree.structure(tuple(examples))
    graph = Graph(branch_cost, unrolled, unrolled_arrays, unrolled_on_request)
    inputs = [
        _inputs(graph, number, variable.aval, varies)
        for number, (variable, varies) in enumerate(zip(program.jaxpr.invars, varying, strict=True))
    ]
    with np.errstate(all="ignore"):
        results = evaluate.run(graph, program, inputs)
    outputs = [arrays.elements(result) for result in results]
    out_avals, out_tree = jax.tree.flatten(out_shape)
    return Scalarized(
        in_tree=in_tree,
        in_avals=[variable.aval for variable in program.jaxpr.invars],
        out_tree=out_tree,
        out_avals=out_avals,
        outputs=outputs,
        schedule=liveness.schedule(graph.scope, (x for leaf in outputs for x in leaf)),
        captures=graph.captures,
    )


def full(value: Any, batch_shape: tuple[int, ...]) -> jax.Array:
    """Gives a shared value or a constant the shape of a lane."""
    if np.shape(value) == batch_shape and not is_constant(value):
        return value
    return lax.broadcast(value, batch_shape)


def _inputs(graph: Graph, number: int, aval: Any, varying: bool) -> np.ndarray:
    size = int(np.prod(aval.shape, dtype=int))
    leaves = [graph.leaf(aval.dtype, varying, position=(number, k)) for k in range(size)]
    return arrays.pack(leaves, aval.shape, aval.dtype)


def _lanes(leaf: Any, shape: tuple[int, ...]) -> list[Any]:
    """Lists the lanes of an object array or of a list nested as deep as the shape says."""
    if isinstance(leaf, np.ndarray) and leaf.dtype == object:
        return list(leaf.flat)
    if not shape:
        return [leaf]
    return [lane for part in leaf for lane in _lanes(part, shape[1:])]
