"""Rules that combine the elements of an array: reductions, prefix sums, order."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs, ops
from mjx_reinforce.engine.scalar.graph import Graph


def _reduce(
    graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, *, combine: str, empty: float
) -> list:
    """Combines the elements along some axes, from the first to the last."""
    axes, aval = tuple(eqn.params["axes"]), eqn.outvars[0].aval
    if x.size == 0:
        return [np.full(aval.shape, empty, aval.dtype)]
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = x.transpose([*kept, *axes]).reshape([int(np.prod(aval.shape, dtype=int)), -1])
    function = functools.partial(graph.call, combine)
    reduced = (functools.reduce(function, arrays.elements(row)) for row in rows)
    return [arrays.pack(reduced, aval.shape, aval.dtype)]


def _cumulate(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, *, combine: str) -> list:
    """Combines each element with all before it (after it, if reversed)."""
    step = -1 if eqn.params["reverse"] else 1
    lines = np.moveaxis(arrays.lift(x), eqn.params["axis"], -1)[..., ::step].copy()
    for line in lines.reshape(-1, lines.shape[-1]):
        for i in range(1, line.size):
            line[i] = graph.call(combine, line[i - 1], line[i])
    lines = np.moveaxis(lines[..., ::step], -1, eqn.params["axis"])
    return [arrays.settle(lines, eqn.outvars[0].aval.dtype)]


def _arg_extreme(
    graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, *, better: str
) -> list[np.ndarray]:
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


def _sort(graph: Graph, eqn: jaxprs.Equation, *operands: np.ndarray) -> list[np.ndarray]:
    """Sorts short arrays by exchanging neighbours, which is stable; NaN comes last."""
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


def _top_k(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    """The k largest elements, the first of equal ones first, and where they are.

    The list of the k largest so far is in order, and each element in turn is put into it, behind
    those that are no smaller.
    """
    k, axis = eqn.params["k"], eqn.params["axis"]
    rows = np.moveaxis(arrays.lift(x), axis, -1)
    found = [_largest(graph, list(row), k) for row in rows.reshape(-1, x.shape[axis])]
    results = []
    for part, out in zip(zip(*found, strict=True), eqn.outvars, strict=True):
        scalars = [scalar for row in part for scalar in row]
        packed = arrays.pack(scalars, (*rows.shape[:-1], k), out.aval.dtype)
        results.append(np.moveaxis(packed, -1, axis))
    return results


def _largest(graph: Graph, row: list, k: int) -> tuple[list, list]:
    """Returns the k largest scalars, and their positions."""
    best: list[tuple] = []  # (order, value, position)
    for i, value in enumerate(row):
        order = _ordered(graph, value)
        moving = order, value, np.int32(i)
        for rank, other in enumerate(best):
            wins = graph.call("gt", order, other[0])
            choose = functools.partial(graph.select, wins)
            best[rank], moving = (
                tuple(map(choose, moving, other)),
                tuple(map(choose, other, moving)),
            )
        if len(best) < k:
            best.append(moving)
    return [value for _, value, _ in best], [position for *_, position in best]


def _ordered(graph: Graph, value: Any) -> Any:
    """Returns an integer that is greater where XLA's total order puts a number higher.

    That is -NaN, -inf, ..., -0, 0, ..., inf, NaN: the order of the bits, but for negative numbers.
    """
    if value.dtype.kind in "biu":
        return value
    integer = np.dtype(f"int{8 * value.dtype.itemsize}")
    op = ops.Op("bitcast_convert_type", (("new_dtype", integer),))
    bits = graph.apply(op, (value,), integer)
    negative = graph.call("lt", bits, integer.type(0))
    flipped = graph.call("xor", bits, integer.type(np.iinfo(integer).max))
    return graph.select(negative, flipped, bits)


def _reducer(combine: str, empty: float) -> Callable:
    return functools.partial(_reduce, combine=combine, empty=empty)


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
    "top_k": _top_k,
}
