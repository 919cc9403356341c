"""Rules that combine elements: reductions, prefix sums, order, and small linear algebra."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.arrays import Array, Results
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.jaxprs import Equation


def _reduce(graph: Graph, eqn: Equation, x: Array, *, combine: str, identity: float) -> list:
    """Combines the elements along some axes, from the first to the last."""
    axes = tuple(eqn.params["axes"])
    aval = eqn.outvars[0].aval
    if x.size == 0:
        return [np.full(aval.shape, identity, aval.dtype)]
    free_axes = [axis for axis in range(x.ndim) if axis not in axes]
    rows = x.transpose([*free_axes, *axes]).reshape([int(np.prod(aval.shape, dtype=int)), -1])
    function = functools.partial(graph.call, combine)
    reductions = (functools.reduce(function, arrays.elements(row)) for row in rows)
    return [arrays.pack(reductions, aval.shape, aval.dtype)]


def _cumulate(graph: Graph, eqn: Equation, x: Array, *, combine: str) -> list:
    """Combines each element with all before it (after it, if reversed)."""
    step = -1 if eqn.params["reverse"] else 1
    lines = np.moveaxis(arrays.lift(x), eqn.params["axis"], -1)[..., ::step].copy()
    for line in lines.reshape(-1, lines.shape[-1]):
        for i in range(1, line.size):
            line[i] = graph.call(combine, line[i - 1], line[i])
    lines = np.moveaxis(lines[..., ::step], -1, eqn.params["axis"])
    return [arrays.settle(lines, eqn.outvars[0].aval.dtype)]


def _arg_extreme(graph: Graph, eqn: Equation, x: Array, *, order: str) -> Results:
    """The position of the first extreme element; the first NaN counts as extreme."""
    (axis,) = eqn.params["axes"]
    aval = eqn.outvars[0].aval
    rows = np.moveaxis(x, axis, -1).reshape(-1, x.shape[axis])
    positions = [_first_extreme(graph, arrays.elements(row), order, aval.dtype) for row in rows]
    return [arrays.pack(positions, aval.shape, aval.dtype)]


def _first_extreme(graph: Graph, row: list, order: str, dtype: np.dtype) -> Any:
    """Returns the position in a row of the element that is better than all others."""
    peak = row[0]
    position = dtype.type(0)
    for i, value in enumerate(row[1:], 1):
        # A NaN wins against numbers, and nothing wins against it: best == best is false for it.
        is_peak = graph.call("or", graph.call(order, value, peak), graph.call("ne", value, value))
        is_peak = graph.call("and", is_peak, graph.call("eq", peak, peak))
        peak = graph.select(is_peak, value, peak)
        position = graph.select(is_peak, dtype.type(i), position)
    return position


def _sort(graph: Graph, eqn: Equation, *operands: Array) -> Results:
    """Sorts short arrays by exchanging neighbors, which is stable; NaN comes last."""
    axis = eqn.params["dimension"]
    num_keys = eqn.params["num_keys"]
    columns = [np.moveaxis(arrays.lift(x), axis, -1).copy() for x in operands]
    size = columns[0].shape[-1]
    for lines in zip(*(column.reshape(-1, size) for column in columns), strict=True):
        # As many rounds as elements: in each, pairs of neighbors, the even and the odd ones in
        # turn.
        for start in range(size):
            for i in range(start % 2, size - 1, 2):
                _exchange(graph, lines, i, num_keys)
    return [
        arrays.settle(np.moveaxis(column, -1, axis), out.aval.dtype)
        for column, out in zip(columns, eqn.outvars, strict=True)
    ]


def _exchange(graph: Graph, lines: Any, i: int, num_keys: int) -> None:
    """Puts elements i and i + 1 in order, in place."""
    swap = np.False_
    # From the last key to the first: where a key is equal, the keys behind it decide.
    for line in reversed(lines[:num_keys]):
        is_less = _precedes(graph, line[i + 1], line[i])
        is_greater = _precedes(graph, line[i], line[i + 1])
        is_equal = graph.call("not", graph.call("or", is_less, is_greater))
        swap = graph.call("or", is_less, graph.call("and", is_equal, swap))
    for line in lines:
        low = line[i]
        high = line[i + 1]
        line[i] = graph.select(swap, high, low)
        line[i + 1] = graph.select(swap, low, high)


def _precedes(graph: Graph, x: Any, y: Any) -> Any:
    """Returns whether x < y, where NaN is above everything."""
    is_number = graph.call("eq", x, x)
    is_nan = graph.call("ne", y, y)
    return graph.call("or", graph.call("lt", x, y), graph.call("and", is_number, is_nan))


def _reducer(combine: str, identity: float) -> Callable:
    return functools.partial(_reduce, combine=combine, identity=identity)


def _dot_general(graph: Graph, eqn: Equation, x: Array, y: Array) -> Results:
    """Returns a dot product for each pair of a row of x and one of y, batch by batch."""
    (x_sum, y_sum), (x_batch, y_batch) = eqn.params["dimension_numbers"]
    aval = eqn.outvars[0].aval
    x_rows = _as_matrices(_cast(graph, eqn.invars[0].aval, x, aval.dtype), x_batch, x_sum)
    y_rows = _as_matrices(_cast(graph, eqn.invars[1].aval, y, aval.dtype), y_batch, y_sum)
    products = [
        _dot(graph, arrays.elements(x_row), arrays.elements(y_row), aval.dtype)
        for x_matrix, y_matrix in zip(x_rows, y_rows, strict=True)
        for x_row in x_matrix
        for y_row in y_matrix
    ]
    return [arrays.pack(products, aval.shape, aval.dtype)]


def _cast(graph: Graph, aval: jaxprs.Shape, x: Array, dtype: DTypeLike) -> Array:
    if aval.dtype == dtype:
        return x
    return arrays.map_elements(lambda value: graph.convert(value, dtype), x.shape, dtype, x)


def _as_matrices(x: Array, batch: tuple, sum_axes: tuple) -> Array:
    """Returns x as [batch, free, contracted]."""
    free_axes = [axis for axis in range(x.ndim) if axis not in (*batch, *sum_axes)]
    groups = [[x.shape[axis] for axis in axes] for axes in (batch, free_axes, sum_axes)]
    sizes = [int(np.prod(group, dtype=int)) for group in groups]
    return x.transpose([*batch, *free_axes, *sum_axes]).reshape(sizes)


def _dot(graph: Graph, x: list, y: list, dtype: DTypeLike) -> Any:
    # From 0 on, which folds away: there may be no terms.
    terms = [graph.call("mul", a, b) for a, b in zip(x, y, strict=True)]
    add = functools.partial(graph.call, "add")
    return functools.reduce(add, terms, np.dtype(dtype).type(0))


def _minus_dot(graph: Graph, start: Any, x: list, y: list) -> Any:
    for a, b in zip(x, y, strict=True):
        start = graph.call("sub", start, graph.call("mul", a, b))
    return start


def _cholesky(graph: Graph, eqn: Equation, x: Array) -> Results:
    """The lower factor; NaN where the matrix is not positive definite."""
    size = x.shape[-1]
    dtype = eqn.outvars[0].aval.dtype
    matrices = arrays.lift(x).reshape(-1, size, size)
    factors = [_factor(graph, matrix, size, dtype) for matrix in matrices]
    return [arrays.settle(np.stack(factors).reshape(x.shape), dtype)]


def _factor(graph: Graph, matrix: Array, size: int, dtype: DTypeLike) -> Array:
    """Returns the lower factor of one matrix, column by column."""
    lower = arrays.lift(np.zeros((size, size), dtype))
    for j in range(size):
        row = list(lower[j, :j])
        lower[j, j] = graph.call("sqrt", _minus_dot(graph, matrix[j, j], row, row))
        for i in range(j + 1, size):
            numerator = _minus_dot(graph, matrix[i, j], list(lower[i, :j]), row)
            lower[i, j] = _divided(graph, numerator, lower[j, j])
    return lower


def _divided(graph: Graph, value: Any, pivot: Any) -> Any:
    """Returns value / pivot: a pivot divides many values, and is inverted once for all of them."""
    return graph.call("mul", value, graph.call("div", value.dtype.type(1), pivot))


def _triangular_solve(graph: Graph, eqn: Equation, a: Array, b: Array) -> Results:
    """Solves op(a) x = b, or x op(a) = b, matrix by matrix."""
    params = eqn.params
    aval = eqn.outvars[0].aval
    lower = params["lower"]
    if params["transpose_a"]:
        a = np.swapaxes(a, -1, -2)
        lower = not lower
    if not params["left_side"]:  # x a = b is a' x' = b'
        a = np.swapaxes(a, -1, -2)
        b = np.swapaxes(b, -1, -2)
        lower = not lower
    *batch, size, columns = b.shape
    matrices = a.reshape(-1, size, size)
    blocks = b.reshape(-1, size, columns)
    solutions = [
        _substitute(graph, matrix, column, lower, params["unit_diagonal"])
        for matrix, block in zip(matrices, blocks, strict=True)
        for column in block.T
    ]
    # The rows of the packed array are the solved columns: those of x, or of x' where the equation
    # was transposed.
    x = arrays.pack(itertools.chain(*solutions), (*batch, columns, size), aval.dtype)
    if params["left_side"]:
        x = np.swapaxes(x, -1, -2)
    return [x]


def _substitute(graph: Graph, matrix: Array, rhs: Any, lower: bool, unit: bool) -> list:
    """Solves one triangular system by substitution."""
    matrix = arrays.lift(matrix)
    solution = arrays.elements(rhs)
    size = len(solution)
    # Each unknown needs those before it in a lower matrix, those behind it in an upper one.
    order = range(size) if lower else range(size - 1, -1, -1)
    for i in order:
        known_rows = slice(0, i) if lower else slice(i + 1, size)
        value = _minus_dot(graph, solution[i], list(matrix[i, known_rows]), solution[known_rows])
        if not unit:
            value = _divided(graph, value, matrix[i, i])
        solution[i] = value
    return solution


RULES = {
    "reduce_sum": _reducer("add", 0),
    "reduce_prod": _reducer("mul", 1),
    "reduce_max": _reducer("max", -np.inf),
    "reduce_min": _reducer("min", np.inf),
    "reduce_and": _reducer("and", True),
    "reduce_or": _reducer("or", False),
    "reduce_xor": _reducer("xor", False),
    "cumsum": functools.partial(_cumulate, combine="add"),
    "cumprod": functools.partial(_cumulate, combine="mul"),
    "cummax": functools.partial(_cumulate, combine="max"),
    "cummin": functools.partial(_cumulate, combine="min"),
    "argmax": functools.partial(_arg_extreme, order="gt"),
    "argmin": functools.partial(_arg_extreme, order="lt"),
    "sort": _sort,
    "dot_general": _dot_general,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
}
