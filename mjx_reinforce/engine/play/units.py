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
        return _whole_network(layers, x)
    while len(layers) > 1:
        layer, next_layer, *layers = layers
        num_units = len(layer["bias"])
        # A scan has iterations of one size alone: a divisor of the number of units.
        group = math.gcd(num_units, _UNITS_AT_ONCE)
        weights = layer["kernel"].T, layer["bias"], next_layer["kernel"]
        rows = [w.reshape(num_units // group, group, *w.shape[1:]) for w in weights]
        bias = next_layer["bias"].astype(jnp.result_type(x, *weights, next_layer["bias"]))
        # Of a function that it knows, JAX takes the body that it traced before, with its x.
        x, _ = lax.scan(functools.partial(_add_units, x), bias, rows)
        # Without further layers this was the last one, which is linear.
        if layers:
            x = jnp.tanh(x)
    if not layers:
        return x
    return jnp.dot(x, layers[0]["kernel"]) + layers[0]["bias"]


def _whole_network(layers: Sequence[Mapping[str, jax.Array]], x: jax.Array) -> jax.Array:
    """Returns what ``tanh_network`` does, in an operation a layer, which device code computes."""
    for layer_index, layer in enumerate(layers):
        name = "tanh_layer" if layer_index + 1 < len(layers) else "layer"
        weights = layer["kernel"]
        bias = layer["bias"]
        units = jax.ShapeDtypeStruct(bias.shape, jnp.result_type(x, weights, bias))
        x = whole(name, {"units": units}, x, weights, bias)["units"]
    return x


def _add_units(
    x: jax.Array, sums: jax.Array, weights: Sequence[jax.Array]
) -> tuple[jax.Array, None]:
    """Adds a few units of a layer to all units of the next, for ``lax.scan``.

    Args:
      x: [I] what the layer reads.
      sums: [O] the next layer's, of its bias and of the units before.
      weights: of G units: into them [G, I], their bias [G], and out of them [G, O].
    """
    weights_in, biases, weights_out = weights
    units = [jnp.tanh(jnp.dot(x, row) + bias) for row, bias in zip(weights_in, biases, strict=True)]
    # One unit after the other, in order: a matrix product would be free to add up otherwise.
    for unit, row in zip(units, weights_out, strict=True):
        sums = sums + unit * row
    return sums, None
