"""Rules for the primitives that work on each element alone."""

from collections.abc import Callable, Sequence

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs, ops
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.passes import simplify


def _elementwise(graph: Graph, eqn: jaxprs.Equation, *operands: np.ndarray) -> list[np.ndarray]:
    """The general rule: the operation has the primitive's name."""
    name = eqn.primitive.name
    params = tuple(sorted(eqn.params.items())) if ops.FACTS[name].has_params else ()
    return [_map_op(graph, ops.Op(name, params), eqn.outvars[0].aval, operands)]


def _map_op(
    graph: Graph, op: ops.Op, aval: jaxprs.Shape, operands: Sequence[np.ndarray]
) -> np.ndarray:
    if all(map(arrays.is_numeric, operands)):
        return np.asarray(simplify.fold(op, operands, aval.dtype))
    apply, dtype = graph.apply, np.dtype(aval.dtype)
    return arrays.map_elements(lambda *args: apply(op, args, dtype), aval.shape, dtype, *operands)


def _convert(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    if eqn.invars[0].aval.dtype == aval.dtype:
        return [x]
    return [_map_op(graph, ops.conversion(np.dtype(aval.dtype)), aval, (x,))]


def _bitcast(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    if x.shape != eqn.outvars[0].aval.shape:
        raise jaxprs.no_rule("bitcast_convert_type to another size", graph.source(eqn))
    return _elementwise(graph, eqn, x)


def _as(name: str) -> Callable[..., list[np.ndarray]]:
    """Returns the rule of an operation under another name."""
    return lambda graph, eqn, *xs: [_map_op(graph, ops.Op(name), eqn.outvars[0].aval, xs)]


def _clamp(
    graph: Graph, eqn: jaxprs.Equation, low: np.ndarray, x: np.ndarray, high: np.ndarray
) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    raised = _map_op(graph, ops.Op("max"), aval, (x, low))
    return [_map_op(graph, ops.Op("min"), aval, (raised, high))]


def _integer_pow(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    return [
        arrays.map_elements(
            lambda base: simplify.power(graph, base, eqn.params["y"]), aval.shape, aval.dtype, x
        )
    ]


def _pow_rule(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """An exponent may be an integer under a float base."""
    exponent = y if y.dtype in (object, x.dtype) else y.astype(eqn.outvars[0].aval.dtype)
    return [_map_op(graph, ops.Op("pow"), eqn.outvars[0].aval, (x, exponent))]


RULES = {
    **dict.fromkeys(ops.FACTS, _elementwise),
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "add_any": lambda graph, eqn, x, y: [
        _map_op(graph, ops.Op("add"), eqn.outvars[0].aval, (x, y))
    ],
    "square": lambda graph, eqn, x: [_map_op(graph, ops.Op("mul"), eqn.outvars[0].aval, (x, x))],
    "clamp": _clamp,
    "integer_pow": _integer_pow,
    "pow": _pow_rule,
}
