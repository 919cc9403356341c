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


def _reduce(graph: Graph, eqn: Equation, x: Array, *, combine: str, empty: float) -> list:
    """Combines the elements along some axes, from the first to the last."""
    axes, aval = tuple(eqn.params["axes"]), eqn.outvars[0].aval
    if x.size == 0:
        return [np.full(aval.shape, empty, aval.dtype)]
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = x.transpose([*kept, *axes]).reshape([int(np.prod(aval.shape, dtype=int)), -1])
    function = functools.partial(graph.call, combine)
    reduced = (functools.reduce(function, arrays.elements(row)) for row in rows)
    return [arrays.pack(reduced, aval.shape, aval.dtype)]


def _cumulate(graph: Graph, eqn: Equation, x: Array, *, combine: str) -> list:
    """Combines each element with all before it (after it, if reversed)."""
    step = -1 if eqn.params["reverse"] else 1
    lines = np.moveaxis(arrays.lift(x), eqn.params["axis"], -1)[..., ::step].copy()
    for line in lines.reshape(-1, lines.shape[-1]):
        for i in range(1, line.size):
            line[i] = graph.call(combine, line[i - 1], line[i])
    lines = np.moveaxis(lines[..., ::step], -1, eqn.params["axis"])
    return [arrays.settle(lines, eqn.outvars[0].aval.dtype)]


def _arg_extreme(graph: Graph, eqn: Equation, x: Array, *, better: str) -> Results:
    """The position of the first extreme element; the first NaN counts as extreme."""
    (axis,), aval = eqn.params["axes"], eqn.outvars[0].aval
    rows = np.moveaxis(x, axis, -1).reshape(-1, x.shape[axis])
    positions = [_first_extreme(graph, arrays.elements(row), better, aval.dtype) for row in rows]
    return [arrays.pack(positions, aval.shape, aval.dtype)]


def _first_extreme(graph: Graph, row: list, better: str, dtype: np.dtype) -> Any:
    best, where = row[0], dtype.type(0)
    for i, value in enumerate(row[1:], 1):
        wins = graph.call("or", graph.call(better, value, best), graph.call("ne", value, value))
        wins = graph.call("and", wins, graph.call("eq", best, best))
        best = graph.select(wins, value, best)
        where = graph.select(wins, dtype.type(i), where)
    return where


def _sort(graph: Graph, eqn: Equation, *operands: Array) -> Results:
    """Sorts short arrays by exchanging neighbors, which is stable; NaN comes last."""
    axis, num_keys = eqn.params["dimension"], eqn.params["num_keys"]
    columns = [np.moveaxis(arrays.lift(x), axis, -1).copy() for x in operands]
    size = columns[0].shape[-1]
    for lines in zip(*(column.reshape(-1, size) for column in columns), strict=True):
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
    for line in reversed(lines[:num_keys]):
        less = _precedes(graph, line[i + 1], line[i])
        equal = graph.call("not", graph.call("or", less, _precedes(graph, line[i], line[i + 1])))
        swap = graph.call("or", less, graph.call("and", equal, swap))
    for line in lines:
        low, high = line[i], line[i + 1]
        line[i], line[i + 1] = graph.select(swap, high, low), graph.select(swap, low, high)


def _precedes(graph: Graph, x: Any, y: Any) -> Any:
    """Returns whether x < y, where NaN is above everything."""
    number, nan = graph.call("eq", x, x), graph.call("ne", y, y)
    return graph.call("or", graph.call("lt", x, y), graph.call("and", number, nan))


def _reducer(combine: str, empty: float) -> Callable:
    return functools.partial(_reduce, combine=combine, empty=empty)


def _dot_general(graph: Graph, eqn: Equation, x: Array, y: Array) -> Results:
    (x_sum, y_sum), (x_batch, y_batch) = eqn.params["dimension_numbers"]
    aval = eqn.outvars[0].aval
    x_rows = _as_matrices(_cast(graph, eqn.invars[0].aval, x, aval.dtype), x_batch, x_sum)
    y_rows = _as_matrices(_cast(graph, eqn.invars[1].aval, y, aval.dtype), y_batch, y_sum)
    products = [
        _dot(graph, arrays.elements(left), arrays.elements(right), aval.dtype)
        for x_matrix, y_matrix in zip(x_rows, y_rows, strict=True)
        for left in x_matrix
        for right in y_matrix
    ]
    return [arrays.pack(products, aval.shape, aval.dtype)]


def _cast(graph: Graph, aval: jaxprs.Shape, x: Array, dtype: DTypeLike) -> Array:
    if aval.dtype == dtype:
        return x
    return arrays.map_elements(lambda value: graph.convert(value, dtype), x.shape, dtype, x)


def _as_matrices(x: Array, batch: tuple, contracted: tuple) -> Array:
    """Returns x as [batch, free, contracted]."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *contracted)]
    groups = [[x.shape[axis] for axis in axes] for axes in (batch, free, contracted)]
    sizes = [int(np.prod(group, dtype=int)) for group in groups]
    return x.transpose([*batch, *free, *contracted]).reshape(sizes)


def _dot(graph: Graph, left: list, right: list, dtype: DTypeLike) -> Any:
    terms = [graph.call("mul", a, b) for a, b in zip(left, right, strict=True)]
    add = functools.partial(graph.call, "add")
    return functools.reduce(add, terms, np.dtype(dtype).type(0))


def _minus_dot(graph: Graph, start: Any, left: list, right: list) -> Any:
    for a, b in zip(left, right, strict=True):
        start = graph.call("sub", start, graph.call("mul", a, b))
    return start


def _cholesky(graph: Graph, eqn: Equation, x: Array) -> Results:
    """The lower factor; NaN where the matrix is not positive definite."""
    size, dtype = x.shape[-1], eqn.outvars[0].aval.dtype
    factors = [
        _factor(graph, arrays.lift(matrix), size, dtype) for matrix in x.reshape(-1, size, size)
    ]
    return [arrays.settle(np.stack(factors).reshape(x.shape), dtype)]


def _factor(graph: Graph, matrix: Array, size: int, dtype: DTypeLike) -> Array:
    lower = arrays.lift(np.zeros((size, size), dtype))
    for j in range(size):
        row = list(lower[j, :j])
        lower[j, j] = graph.call("sqrt", _minus_dot(graph, matrix[j, j], row, row))
        for i in range(j + 1, size):
            rest = _minus_dot(graph, matrix[i, j], list(lower[i, :j]), row)
            lower[i, j] = _divided(graph, rest, lower[j, j])
    return lower


def _divided(graph: Graph, value: Any, pivot: Any) -> Any:
    """Returns value / pivot: a pivot divides many values, and is inverted once for all of them."""
    return graph.call("mul", value, graph.call("div", value.dtype.type(1), pivot))


def _triangular_solve(graph: Graph, eqn: Equation, a: Array, b: Array) -> Results:
    """Solves op(a) x = b, or x op(a) = b, matrix by matrix."""
    params, aval = eqn.params, eqn.outvars[0].aval
    lower = params["lower"] != params["transpose_a"]
    matrices = np.swapaxes(a, -1, -2) if params["transpose_a"] else a
    if not params["left_side"]:  # x a = b is a' x' = b'
        matrices, b, lower = np.swapaxes(matrices, -1, -2), np.swapaxes(b, -1, -2), not lower
    batch, (size, columns) = b.shape[:-2], b.shape[-2:]
    solved = [
        _substitute(graph, matrix, column, lower, params["unit_diagonal"])
        for matrix, block in zip(
            matrices.reshape(-1, size, size), b.reshape(-1, size, columns), strict=True
        )
        for column in block.T
    ]
    x = arrays.pack(itertools.chain(*solved), (*batch, columns, size), aval.dtype)
    return [np.swapaxes(x, -1, -2) if params["left_side"] else x]


def _substitute(graph: Graph, matrix: Array, rhs: Any, lower: bool, unit: bool) -> list:
    """Solves one triangular system by substitution."""
    matrix, solution = arrays.lift(matrix), arrays.elements(rhs)
    size = len(solution)
    for i in range(size) if lower else range(size - 1, -1, -1):
        known = slice(0, i) if lower else slice(i + 1, size)
        rest = _minus_dot(graph, solution[i], list(matrix[i, known]), solution[known])
        solution[i] = rest if unit else _divided(graph, rest, matrix[i, i])
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
    "argmax": functools.partial(_arg_extreme, better="gt"),
    "argmin": functools.partial(_arg_extreme, better="lt"),
    "sort": _sort,
    "dot_general": _dot_general,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
}
