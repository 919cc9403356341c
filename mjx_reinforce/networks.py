"""Networks, shared by policies and critics."""

from collections.abc import Sequence

import jax
from flax import linen as nn

# TF32, the default of NVIDIA's matrix units, breaks small policies quietly.
_PRECISION = jax.lax.Precision.HIGHEST


class MLP(nn.Module):
    """A multilayer perceptron with tanh units and a linear last layer.

    hidden_sizes: units of each hidden layer; none for a linear function
    num_outputs: entries of the output
    output_scale: gain of the last layer's orthogonal initial weights; 0.01 makes
      every fresh policy nearly the same in all states (Andrychowicz et al. 2020,
      arXiv:2006.05990, section 3.2)
    """

    hidden_sizes: Sequence[int]
    num_outputs: int
    output_scale: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Returns [..., num_outputs] from ``x`` [..., O]."""
        for size in self.hidden_sizes:
            x = nn.tanh(nn.Dense(size, precision=_PRECISION)(x))
        initializer = nn.initializers.orthogonal(self.output_scale)
        return nn.Dense(self.num_outputs, kernel_init=initializer, precision=_PRECISION)(x)
