"""Rules that move elements about, and those that work on each element alone."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.arrays import Array, Results
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.jaxprs import Equation
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS, Op, conversion
from mjx_reinforce.engine.scalar.passes import simplify


def _slice(graph: Graph, eqn: Equation, x: Array) -> Results:
    params = eqn.params
    strides = params["strides"] or (1,) * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [x[tuple(slice(*bound) for bound in bounds)]]


def _broadcast_in_dim(graph: Graph, eqn: Equation, x: Array) -> Results:
    shape = eqn.params["shape"]
    aligned_shape = [1] * len(shape)
    for axis, target in enumerate(eqn.params["broadcast_dimensions"]):
        aligned_shape[target] = x.shape[axis]
    return [np.broadcast_to(x.reshape(aligned_shape), shape)]


def _unstack(graph: Graph, eqn: Equation, x: Array) -> Results:
    axis = eqn.params["axis"]
    return [x.take([i], axis).squeeze(axis) for i in range(x.shape[axis])]


def _split(graph: Graph, eqn: Equation, x: Array) -> Results:
    bounds = np.cumsum(eqn.params["sizes"])[:-1]
    return list(np.split(x, bounds, eqn.params["axis"]))


def _pad(graph: Graph, eqn: Equation, x: Array, value: Array) -> Results:
    """Writes x, spread by the interior padding, into an array of the value."""
    x, value = arrays.together([x, value])
    shape = eqn.outvars[0].aval.shape
    output = np.broadcast_to(value, shape).copy()
    target = []
    origin = []
    for size, limit, (low, _, interior) in zip(
        x.shape, shape, eqn.params["padding_config"], strict=True
    ):
        places = low + np.arange(size) * (interior + 1)
        # Negative padding cuts entries off.
        is_inside = (places >= 0) & (places < limit)
        target.append(places[is_inside])
        origin.append(np.flatnonzero(is_inside))
    output[np.ix_(*target)] = x[np.ix_(*origin)]
    return [output]


def _iota(graph: Graph, eqn: Equation) -> Results:
    """Counts along one axis."""
    aval = eqn.outvars[0].aval
    axis = eqn.params["dimension"]
    line = np.arange(aval.shape[axis]).astype(aval.dtype)
    aligned_shape = [1] * len(aval.shape)
    aligned_shape[axis] = -1
    return [np.broadcast_to(line.reshape(aligned_shape), aval.shape)]


def _platform_index(graph: Graph, eqn: Equation) -> Results:
    default = jaxprs.default_platform(eqn)
    if default is None:
        raise jaxprs.no_rule("platform_dependent without a default", graph.source(eqn))
    return [np.asarray(default, eqn.outvars[0].aval.dtype)]


def _moved(move: Callable[..., Array]) -> Callable[..., Results]:
    """Returns a rule: (parameters, shape of the result, operands) -> the result."""
    return lambda graph, eqn, *operands: [move(eqn.params, eqn.outvars[0].aval, *operands)]


#: What changes no element here. A key is an array of its words, wrapped or not.
_IDENTITIES = (
    "copy", "copy_p", "device_put", "name", "optimization_barrier", "pvary", "random_wrap",
    "random_unwrap", "reshard", "sharding_constraint", "stop_gradient",
)  # fmt: skip


def _elementwise(graph: Graph, eqn: Equation, *operands: Array) -> Results:
    """The general rule: the operation has the primitive's name."""
    name = eqn.primitive.name
    params = ()
    if OP_TRAITS[name].has_params:
        params = tuple(sorted(eqn.params.items()))
    return [_map_op(graph, Op(name, params), eqn.outvars[0].aval, operands)]


def _map_op(graph: Graph, op: Op, aval: jaxprs.Shape, operands: Sequence[Array]) -> Array:
    """Returns the array of an operation, whose operands broadcast to the shape of ``aval``."""
    # All elements at once in NumPy: a model's constants are large arrays.
    if all(map(arrays.is_numeric, operands)):
        return np.asarray(simplify.fold(op, operands, aval.dtype))
    dtype = np.dtype(aval.dtype)
    return arrays.map_elements(
        lambda *args: graph.apply(op, args, dtype), aval.shape, dtype, *operands
    )


def _convert(graph: Graph, eqn: Equation, x: Array) -> Results:
    aval = eqn.outvars[0].aval
    if eqn.invars[0].aval.dtype == aval.dtype:
        return [x]
    return [_map_op(graph, conversion(np.dtype(aval.dtype)), aval, (x,))]


def _bitcast(graph: Graph, eqn: Equation, x: Array) -> Results:
    if x.shape != eqn.outvars[0].aval.shape:
        raise jaxprs.no_rule("bitcast_convert_type to another size", graph.source(eqn))
    return _elementwise(graph, eqn, x)


def _clamp(graph: Graph, eqn: Equation, low: Array, x: Array, high: Array) -> Results:
    aval = eqn.outvars[0].aval
    lower_bounded = _map_op(graph, Op("max"), aval, (x, low))
    return [_map_op(graph, Op("min"), aval, (lower_bounded, high))]


def _integer_pow(graph: Graph, eqn: Equation, x: Array) -> Results:
    aval = eqn.outvars[0].aval
    power = functools.partial(simplify.power, graph, exponent=eqn.params["y"])
    return [arrays.map_elements(power, aval.shape, aval.dtype, x)]


def _pow_rule(graph: Graph, eqn: Equation, x: Array, y: Array) -> Results:
    """An exponent may be an integer under a float base."""
    aval = eqn.outvars[0].aval
    if y.dtype not in (object, x.dtype):
        y = y.astype(aval.dtype)
    return [_map_op(graph, Op("pow"), aval, (x, y))]


RULES = {
    **dict.fromkeys(_IDENTITIES, lambda graph, eqn, *operands: list(operands)),
    **dict.fromkeys(
        ("reshape", "squeeze", "expand_dims"), _moved(lambda _, aval, x: x.reshape(aval.shape))
    ),
    "slice": _slice,
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": _moved(lambda params, _, x: x.transpose(params["permutation"])),
    "rev": _moved(lambda params, _, x: np.flip(x, params["dimensions"])),
    "tile": _moved(lambda params, _, x: np.tile(x, params["reps"])),
    "concatenate": _moved(
        lambda params, _, *xs: np.concatenate(arrays.together(xs), params["dimension"])
    ),
    "stack": _moved(lambda params, _, *xs: np.stack(arrays.together(xs), params["axis"])),
    "unstack": _unstack,
    "split": _split,
    "pad": _pad,
    "iota": _iota,
    "empty": _moved(lambda _, aval: arrays.zeros(aval)),
    "platform_index": _platform_index,
    **dict.fromkeys(OP_TRAITS, _elementwise),
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "add_any": lambda graph, eqn, x, y: [_map_op(graph, Op("add"), eqn.outvars[0].aval, (x, y))],
    "square": lambda graph, eqn, x: [_map_op(graph, Op("mul"), eqn.outvars[0].aval, (x, x))],
    "clamp": _clamp,
    "integer_pow": _integer_pow,
    "pow": _pow_rule,
}
