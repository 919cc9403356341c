"""A network of one observation as loops over its units, so that it is a short program."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.policies.policy import MLP

#: Units of one iteration. Their activations do not wait for each other, and the sums of the next
#: layer stay in registers from one to the next.
_UNITS_AT_ONCE = 4


def unit_by_unit(
    call: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], context: Any
) -> Any:
    """Computes an ``MLP`` of one observation two layers at a time, as a loop; for flax to call.

    Each unit of the first layer is computed and at once added to all units of the second, in the
    order of the units. Written out, a network of 64 and 64 units would be a program of 9,000
    operations.
    """
    network = context.module
    if not (isinstance(network, MLP) and context.method_name == "__call__" and args[0].ndim == 1):
        return call(*args, **kwargs)
    params = network.variables["params"]
    layers = [params[f"Dense_{i}"] for i in range(len(params))]
    x = args[0]
    while len(layers) > 1:
        first, second, *layers = layers
        size = len(first["bias"])
        together = math.gcd(size, _UNITS_AT_ONCE)
        weights = first["kernel"].T, first["bias"], second["kernel"]
        rows = [w.reshape(size // together, together, *w.shape[1:]) for w in weights]
        bias = second["bias"].astype(jnp.result_type(x, *weights, second["bias"]))
        # Of a function that it knows, JAX takes the body that it traced before, with its x.
        x, _ = lax.scan(functools.partial(_add_units, x), bias, rows)
        x = jnp.tanh(x) if layers else x
    return jnp.dot(x, layers[0]["kernel"]) + layers[0]["bias"] if layers else x


def _add_units(x: jax.Array, sums: jax.Array, weights: Any) -> tuple[jax.Array, None]:
    """Adds a few units of a layer to all units of the next."""
    units = [jnp.tanh(jnp.dot(x, into) + bias) for into, bias in zip(*weights[:2], strict=True)]
    for unit, out in zip(units, weights[2], strict=True):
        sums = sums + unit * out
    return sums, None
