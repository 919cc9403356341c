"""Rules for small linear algebra, written out in scalars."""

import functools
import itertools
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.graph import Graph


def _dot_general(
    graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, y: np.ndarray
) -> list[np.ndarray]:
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


def _cast(graph: Graph, aval: jaxprs.Shape, x: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    if aval.dtype == dtype:
        return x
    return arrays.map_elements(lambda value: graph.convert(value, dtype), x.shape, dtype, x)


def _as_matrices(x: np.ndarray, batch: tuple, contracted: tuple) -> np.ndarray:
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


def _cholesky(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    """The lower factor; NaN where the matrix is not positive definite."""
    size, dtype = x.shape[-1], eqn.outvars[0].aval.dtype
    factors = [
        _factor(graph, arrays.lift(matrix), size, dtype) for matrix in x.reshape(-1, size, size)
    ]
    return [arrays.settle(np.stack(factors).reshape(x.shape), dtype)]


def _factor(graph: Graph, matrix: np.ndarray, size: int, dtype: DTypeLike) -> np.ndarray:
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


def _triangular_solve(
    graph: Graph, eqn: jaxprs.Equation, a: np.ndarray, b: np.ndarray
) -> list[np.ndarray]:
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


def _substitute(graph: Graph, matrix: np.ndarray, rhs: Any, lower: bool, unit: bool) -> list:
    """Solves one triangular system by substitution."""
    matrix, solution = arrays.lift(matrix), arrays.elements(rhs)
    size = len(solution)
    for i in range(size) if lower else range(size - 1, -1, -1):
        known = slice(0, i) if lower else slice(i + 1, size)
        rest = _minus_dot(graph, solution[i], list(matrix[i, known]), solution[known])
        solution[i] = rest if unit else _divided(graph, rest, matrix[i, i])
    return solution


RULES = {
    "dot_general": _dot_general,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
}
