"""A network of tanh units, two layers at a time: what machine code computes of it.

Written out, a network of 64 and 64 units would be a program of 9,000 operations. As a loop over the
units of a layer it is short. A network that can compute itself so asks ``wanted`` first.
"""

import functools
import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engine.base import is_kept_whole
from mjx_reinforce.engine.scalar import is_written_out, whole

#: Units of one iteration. Their activations do not wait for each other, and the sums of the next
#: layer stay in registers from one to the next.
_UNITS_AT_ONCE = 4


def wanted(observation: jax.Array) -> bool:
    """Returns whether a network of one observation [O] is to compute itself by ``tanh_network``."""
    return is_written_out() and observation.ndim == 1


def tanh_network(layers: Sequence[Mapping[str, jax.Array]], x: jax.Array) -> jax.Array:
    """Returns the outputs of a network with tanh units, whose last layer is linear.

    Each unit of the first layer is computed and at once added to all units of the second, in the
    order of the units.

    Args:
      layers: "kernel" [inputs, outputs] and "bias" [outputs] of each.
      x: [O].
    """
    layers = list(layers)
    if is_kept_whole():
        for number, layer in enumerate(layers):
            name = "tanh_layer" if number + 1 < len(layers) else "layer"
            weights = layer["kernel"], layer["bias"]
            shape = jax.ShapeDtypeStruct(weights[1].shape, jnp.result_type(x, *weights))
            x = whole(name, {"units": shape}, x, *weights)["units"]
        return x
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


def _add_units(
    x: jax.Array, sums: jax.Array, weights: Sequence[jax.Array]
) -> tuple[jax.Array, None]:
    """Adds a few units of a layer to all units of the next."""
    units = [jnp.tanh(jnp.dot(x, into) + bias) for into, bias in zip(*weights[:2], strict=True)]
    for unit, out in zip(units, weights[2], strict=True):
        sums = sums + unit * out
    return sums, None
