"""Rules that move elements about without computing anything."""

import numpy as np

from mjx_reinforce.fused import arrays, jaxprs
from mjx_reinforce.fused.errors import no_rule
from mjx_reinforce.fused.graph import Graph


def _slice(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    params = eqn.params
    strides = params["strides"] or (1,) * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [x[tuple(slice(*bound) for bound in bounds)]]


def _reshape(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    return [x.reshape(eqn.outvars[0].aval.shape)]


def _broadcast_in_dim(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    shape = eqn.params["shape"]
    aligned = [1] * len(shape)
    for axis, target in enumerate(eqn.params["broadcast_dimensions"]):
        aligned[target] = x.shape[axis]
    return [np.broadcast_to(x.reshape(aligned), shape)]


def _transpose(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    return [x.transpose(eqn.params["permutation"])]


def _rev(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    return [np.flip(x, eqn.params["dimensions"])]


def _tile(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    return [np.tile(x, eqn.params["reps"])]


def _concatenate(graph: Graph, eqn: jaxprs.Equation, *operands: np.ndarray) -> list[np.ndarray]:
    return [np.concatenate(arrays.together(operands), eqn.params["dimension"])]


def _stack(graph: Graph, eqn: jaxprs.Equation, *operands: np.ndarray) -> list[np.ndarray]:
    return [np.stack(arrays.together(operands), eqn.params["axis"])]


def _unstack(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    axis = eqn.params["axis"]
    return [x.take([i], axis).squeeze(axis) for i in range(x.shape[axis])]


def _split(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    ends = np.cumsum(eqn.params["sizes"])[:-1]
    return list(np.split(x, ends, eqn.params["axis"]))


def _pad(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray, value: np.ndarray) -> list[np.ndarray]:
    x, value = arrays.together([x, value])
    shape = eqn.outvars[0].aval.shape
    padded = np.broadcast_to(value, shape).copy()
    target, origin = [], []
    for size, limit, (low, _, interior) in zip(
        x.shape, shape, eqn.params["padding_config"], strict=True
    ):
        places = low + np.arange(size) * (interior + 1)
        kept = (places >= 0) & (places < limit)
        target.append(places[kept])
        origin.append(np.flatnonzero(kept))
    padded[np.ix_(*target)] = x[np.ix_(*origin)]
    return [padded]


def _iota(graph: Graph, eqn: jaxprs.Equation) -> list[np.ndarray]:
    aval, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    line = np.arange(aval.shape[axis]).astype(aval.dtype)
    aligned = [-1 if i == axis else 1 for i in range(len(aval.shape))]
    return [np.broadcast_to(line.reshape(aligned), aval.shape)]


def _empty(graph: Graph, eqn: jaxprs.Equation) -> list[np.ndarray]:
    return [arrays.zeros(eqn.outvars[0].aval)]


def _platform_index(graph: Graph, eqn: jaxprs.Equation) -> list[np.ndarray]:
    default = jaxprs.default_platform(eqn)
    if default is None:
        raise no_rule("platform_dependent without a default", graph.source(eqn))
    return [np.asarray(default, eqn.outvars[0].aval.dtype)]


def _identity(graph: Graph, eqn: jaxprs.Equation, *operands: np.ndarray) -> list[np.ndarray]:
    return list(operands)


RULES = {
    "slice": _slice,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": _transpose,
    "rev": _rev,
    "tile": _tile,
    "concatenate": _concatenate,
    "stack": _stack,
    "unstack": _unstack,
    "split": _split,
    "pad": _pad,
    "iota": _iota,
    "empty": _empty,
    "platform_index": _platform_index,
    "copy": _identity,
    "copy_p": _identity,
    "device_put": _identity,
    "name": _identity,
    "optimization_barrier": _identity,
    "pvary": _identity,
    "random_wrap": _identity,
    "random_unwrap": _identity,
    "reshard": _identity,
    "sharding_constraint": _identity,
    "stop_gradient": _identity,
}
