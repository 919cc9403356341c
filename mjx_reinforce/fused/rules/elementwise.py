"""Rules for the primitives that work on each element alone."""

from typing import Any

import numpy as np

from mjx_reinforce.fused import arrays, ops, simplify


def _elementwise(graph: Any, eqn: Any, *operands: np.ndarray) -> list[np.ndarray]:
    """The general rule: an entry of ops.CORE, or the primitive itself."""
    name, aval = eqn.primitive.name, eqn.outvars[0].aval
    op = ops.CORE[name] if name in ops.CORE else ops.of_equation(eqn)
    return [_apply(graph, op, aval, operands)]


def _apply(graph: Any, op: ops.Op, aval: Any, operands: Any) -> np.ndarray:
    if all(map(arrays.is_numeric, operands)):
        return np.asarray(ops.fold(op, operands, aval.dtype))
    apply, dtype = graph.apply, np.dtype(aval.dtype)
    return arrays.map_elements(lambda *args: apply(op, args, dtype), aval.shape, dtype, *operands)


def _convert(graph: Any, eqn: Any, x: np.ndarray) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    if eqn.invars[0].aval.dtype == aval.dtype:
        return [x]
    return [_apply(graph, ops.conversion(np.dtype(aval.dtype)), aval, (x,))]


def _add_any(graph: Any, eqn: Any, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    return [_apply(graph, ops.CORE["add"], eqn.outvars[0].aval, (x, y))]


def _square(graph: Any, eqn: Any, x: np.ndarray) -> list[np.ndarray]:
    return [_apply(graph, ops.CORE["mul"], eqn.outvars[0].aval, (x, x))]


def _clamp(graph: Any, eqn: Any, low: Any, x: np.ndarray, high: Any) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    raised = _apply(graph, ops.CORE["max"], aval, (x, low))
    return [_apply(graph, ops.CORE["min"], aval, (raised, high))]


def _integer_pow(graph: Any, eqn: Any, x: np.ndarray) -> list[np.ndarray]:
    aval = eqn.outvars[0].aval
    return [
        arrays.map_elements(
            lambda base: simplify.power(graph, base, eqn.params["y"]), aval.shape, aval.dtype, x
        )
    ]


def _pow(graph: Any, eqn: Any, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """An exponent may be an integer under a float base."""
    exponent = y if y.dtype in (object, x.dtype) else y.astype(eqn.outvars[0].aval.dtype)
    return [_apply(graph, ops.CORE["pow"], eqn.outvars[0].aval, (x, exponent))]


RULES = {
    **dict.fromkeys(ops.CORE, _elementwise),
    **dict.fromkeys(ops.GENERIC, _elementwise),
    "convert_element_type": _convert,
    "add_any": _add_any,
    "square": _square,
    "clamp": _clamp,
    "integer_pow": _integer_pow,
    "pow": _pow,
}
