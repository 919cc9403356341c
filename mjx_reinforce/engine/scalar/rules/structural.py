"""Rules that move elements about without computing anything."""

from collections.abc import Callable

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.graph import Graph


def _slice(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    params = eqn.params
    strides = params["strides"] or (1,) * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [x[tuple(slice(*bound) for bound in bounds)]]


def _broadcast_in_dim(graph: Graph, eqn: jaxprs.Equation, x: np.ndarray) -> list[np.ndarray]:
    shape = eqn.params["shape"]
    aligned = [1] * len(shape)
    for axis, target in enumerate(eqn.params["broadcast_dimensions"]):
        aligned[target] = x.shape[axis]
    return [np.broadcast_to(x.reshape(aligned), shape)]


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


def _platform_index(graph: Graph, eqn: jaxprs.Equation) -> list[np.ndarray]:
    default = jaxprs.default_platform(eqn)
    if default is None:
        raise jaxprs.no_rule("platform_dependent without a default", graph.source(eqn))
    return [np.asarray(default, eqn.outvars[0].aval.dtype)]


def _moved(move: Callable[..., np.ndarray]) -> Callable[..., list[np.ndarray]]:
    """Returns a rule: (parameters, shape of the result, operands) -> the result."""
    return lambda graph, eqn, *operands: [move(eqn.params, eqn.outvars[0].aval, *operands)]


_IDENTITIES = (
    *("copy", "copy_p", "device_put", "name", "optimization_barrier", "pvary", "random_wrap"),
    *("random_unwrap", "reshard", "sharding_constraint", "stop_gradient"),
)
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
}
