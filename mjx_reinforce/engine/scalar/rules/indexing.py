"""Rules for gather, scatter and dynamic slices.

All of them read or write *windows* of an operand. Where a window starts is mostly a constant, and
then elements are only moved; a start that depends on the lane becomes a chain of selections.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.scalar import arrays
from mjx_reinforce.engine.scalar.arrays import Array, Results
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.jaxprs import Equation
from mjx_reinforce.engine.scalar.nodes import is_constant


class Unknown(NamedTuple):
    """A start that is not a constant.

    index: the scalar that holds it.
    stride: how far apart two starts are in the flat operand.
    num_starts: the number of starts that keep the window inside.
    """

    index: Any
    stride: int
    num_starts: int


class Window(NamedTuple):
    """One window of a flat operand.

    positions: where its elements are while the unknown starts are 0.
    unknowns: the starts that are not constants.
    is_inside: whether the constant starts keep it inside the operand.
    """

    positions: Array
    unknowns: list[Unknown]
    is_inside: bool


def _window(shape: Sequence[int], sizes: Sequence[int], starts: Sequence[Any]) -> Window:
    """Places a window; a constant start is moved to the nearest place inside."""
    strides = [int(np.prod(shape[axis + 1 :], dtype=int)) for axis in range(len(shape))]
    # Where each entry of the window is in the flat operand, if the window starts at its beginning.
    grids = np.meshgrid(*(np.arange(size) for size in sizes), indexing="ij", copy=False)
    positions = np.zeros(tuple(sizes), int)
    for grid, stride in zip(grids, strides, strict=True):
        positions = positions + grid * stride
    unknowns = []
    is_inside = True
    for start, stride, limit, size in zip(starts, strides, shape, sizes, strict=True):
        if isinstance(start, (int, np.integer)):
            clipped_start = min(max(int(start), 0), limit - size)
            is_inside &= clipped_start == start
            positions = positions + clipped_start * stride
        else:
            unknowns.append(Unknown(start, stride, limit - size + 1))
    return Window(positions, unknowns, is_inside)


def _read_window(graph: Graph, cells: Array, positions: Array, unknowns: list) -> Array:
    """Reads a window; an unknown start outside counts as the nearest inside."""
    if not unknowns:
        return arrays.lift(cells[positions.reshape(-1)].reshape(positions.shape))
    (index, stride, count), *inner_unknowns = unknowns
    values = _read_window(graph, cells, positions, inner_unknowns)
    # A chain of selections: start k replaces start k - 1 where the index is at least k.
    for k in range(1, count):
        next_window = _read_window(graph, cells, positions + k * stride, inner_unknowns)
        is_reached = graph.call("ge", index, index.dtype.type(k))
        select = functools.partial(graph.select, is_reached)
        values = arrays.map_elements(select, values.shape, object, next_window, values)
    return values


def _write_window(
    graph: Graph, cells: Array, window: Window, updates: Array, combine: Callable
) -> None:
    """Combines updates into a window, in place; a start outside changes nothing."""
    for steps in itertools.product(*(range(start.num_starts) for start in window.unknowns)):
        # Whether the window starts here, for one place of all that it may have.
        is_hit = np.True_
        offset = 0
        for k, (index, stride, _) in zip(steps, window.unknowns, strict=True):
            is_hit = graph.call("and", is_hit, graph.call("eq", index, index.dtype.type(k)))
            offset += k * stride
        places = (window.positions + offset).reshape(-1)
        for place, update in zip(places, arrays.elements(updates), strict=True):
            cells[place] = graph.select(is_hit, combine(graph, cells[place], update), cells[place])


def _starts(
    indices: Array, rank: int, index_dims: Any, batching_dims: Any, indices_batching_dims: Any
) -> Iterator[list[Any]]:
    """Yields where each window starts, one entry for each axis of the operand."""
    for place in np.ndindex(*indices.shape[:-1]):
        start: list[Any] = [0] * rank
        for k, axis in enumerate(index_dims):
            start[axis] = indices[place][k]
        # Along a batching axis a window lies where its indices lie along theirs.
        for axis, source in zip(batching_dims, indices_batching_dims, strict=True):
            start[axis] = place[source]
        yield start


def _outside_mode(eqn: Equation) -> str:
    """Returns what happens to a window outside: 'drop' or 'clip'."""
    return "drop" if "FILL" in str(eqn.params["mode"]) else "clip"


def _gather_rule(graph: Graph, eqn: Equation, operand: Array, indices: Array) -> Results:
    """Reads a window for each row of indices, and puts them together."""
    dims = eqn.params["dimension_numbers"]
    sizes = eqn.params["slice_sizes"]
    aval = eqn.outvars[0].aval
    cells = operand.reshape(-1)
    # Axes of size 1 that the windows do not show in the result.
    hidden_dims = {*dims.collapsed_slice_dims, *dims.operand_batching_dims}
    window_shape = [size for axis, size in enumerate(sizes) if axis not in hidden_dims]
    batching = (dims.operand_batching_dims, dims.start_indices_batching_dims)
    windows = []
    for start in _starts(indices, operand.ndim, dims.start_index_map, *batching):
        window = _window(operand.shape, sizes, start)
        values = _read_window(graph, cells, window.positions, window.unknowns)
        if _outside_mode(eqn) == "drop":
            values = _fill_outside(graph, eqn, values, window)
        windows.append(values.reshape(window_shape))
    if not windows:
        return [arrays.zeros(aval)]
    output = np.stack(windows).reshape([*indices.shape[:-1], *window_shape])
    # The axes of the windows lie behind those of the indices, and go where XLA has them.
    num_batch_axes = indices.ndim - 1
    sources = range(num_batch_axes, num_batch_axes + len(window_shape))
    output = np.moveaxis(output, list(sources), list(dims.offset_dims))
    return [arrays.settle(output, aval.dtype)]


def _fill_outside(graph: Graph, eqn: Equation, values: Array, window: Window) -> Array:
    """Replaces the values of a window that is outside by the fill value."""
    dtype = np.dtype(eqn.outvars[0].aval.dtype)
    is_inside = np.bool_(window.is_inside)
    for index, _, count in window.unknowns:
        low = graph.call("ge", index, index.dtype.type(0))
        high = graph.call("lt", index, index.dtype.type(count))
        is_inside = graph.call("and", is_inside, graph.call("and", low, high))
    value = eqn.params["fill_value"]
    if value is None:
        value = _default_fill(dtype)
    fill = dtype.type(value)
    return arrays.map_elements(
        lambda x: graph.select(is_inside, x, fill), values.shape, object, values
    )


def _default_fill(dtype: np.dtype) -> Any:
    """Returns what ``jax.lax.gather`` fills with where nothing else is said."""
    if np.issubdtype(dtype, np.signedinteger):
        return np.iinfo(dtype).min
    if np.issubdtype(dtype, np.unsignedinteger):
        return np.iinfo(dtype).max
    if dtype == np.bool_:
        return True
    return np.nan


def _scatter(graph: Graph, eqn: Equation, *operands: Array, combine: Callable) -> Results:
    """Combines a window of updates for each row of indices into a copy of the operand."""
    operand, indices, updates = operands
    dims = eqn.params["dimension_numbers"]
    # Axes that the updates do not have, along which a window has the size 1.
    hidden_dims = {*dims.inserted_window_dims, *dims.operand_batching_dims}
    window_axes = list(dims.update_window_dims)
    update_sizes = iter([updates.shape[axis] for axis in window_axes])
    sizes = [1 if axis in hidden_dims else next(update_sizes) for axis in range(operand.ndim)]
    trailing_dims = range(updates.ndim - len(window_axes), updates.ndim)
    blocks = np.moveaxis(updates, window_axes, list(trailing_dims))
    blocks = blocks.reshape([math.prod(indices.shape[:-1]), math.prod(sizes)])
    cells = arrays.lift(operand).reshape(-1).copy()
    batching = (dims.operand_batching_dims, dims.scatter_indices_batching_dims)
    starts = _starts(indices, operand.ndim, dims.scatter_dims_to_operand_dims, *batching)
    # One after the other, as windows may overlap.
    for start, block in zip(starts, blocks, strict=True):
        if _outside_mode(eqn) == "clip":
            start = _clip(graph, start, operand.shape, sizes)
        window = _window(operand.shape, sizes, start)
        if window.is_inside:
            _write_window(graph, cells, window, block, combine)
    return [arrays.settle(cells.reshape(operand.shape), eqn.outvars[0].aval.dtype)]


def _clip(graph: Graph, starts: Sequence[Any], shape: Sequence[int], sizes: Sequence[int]) -> list:
    """Moves starts to the nearest place that keeps the window inside."""
    corner = []
    for start, limit, size in zip(starts, shape, sizes, strict=True):
        if is_constant(start) or isinstance(start, int):
            corner.append(min(max(int(start), 0), limit - size))
        else:
            low = start.dtype.type(0)
            high = start.dtype.type(limit - size)
            corner.append(graph.call("min", graph.call("max", start, low), high))
    return corner


def _dynamic_slice(graph: Graph, eqn: Equation, operand: Array, *starts: Array) -> Results:
    aval = eqn.outvars[0].aval
    window = _window(operand.shape, eqn.params["slice_sizes"], [s[()] for s in starts])
    values = _read_window(graph, operand.reshape(-1), window.positions, window.unknowns)
    return [arrays.settle(values, aval.dtype)]


def _dynamic_update_slice(
    graph: Graph, eqn: Equation, operand: Array, update: Array, *starts: Array
) -> Results:
    """Replaces a window, which XLA moves to the nearest place inside of the operand."""
    corner = _clip(graph, [s[()] for s in starts], operand.shape, update.shape)
    cells = arrays.lift(operand).reshape(-1).copy()
    _write_window(graph, cells, _window(operand.shape, update.shape, corner), update, _replace)
    return [arrays.settle(cells.reshape(operand.shape), eqn.outvars[0].aval.dtype)]


def _replace(graph: Graph, old_value: Any, new_value: Any) -> Any:
    return new_value


def _combining(name: str) -> Callable:
    return functools.partial(_scatter, combine=lambda graph, x, y: graph.call(name, x, y))


RULES = {
    "gather": _gather_rule,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "scatter": functools.partial(_scatter, combine=_replace),
    **{f"scatter-{name}": _combining(name) for name in ("add", "sub", "mul", "min", "max")},
    **{f"scatter_{name}": _combining(name) for name in ("add", "sub", "mul", "min", "max")},
}
