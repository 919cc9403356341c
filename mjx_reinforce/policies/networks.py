"""The multilayer perceptron of policies and critics."""

from collections.abc import Sequence

import jax
from flax import linen as nn

from mjx_reinforce.registry import check_name

#: The ways to draw initial weights.
INITIALIZERS = ("orthogonal", "torch")

# With TF32, the default on NVIDIA's GPUs, small policies fail to learn and nothing reports it.
_PRECISION = jax.lax.Precision.HIGHEST


class MLP(nn.Module):
    """A multilayer perceptron with tanh units and a linear last layer.

    hidden_sizes: units of each hidden layer; none for a linear function
    num_outputs: entries of the output
    output_scale: gain of the last layer's orthogonal initial weights; with 0.01 an
      untrained policy does nearly the same in all states (Andrychowicz et al. 2020,
      arXiv:2006.05990, section 3.2)
    initializer: "orthogonal": orthogonal weights in the last layer, LeCun's normal
      weights in the hidden layers, zero biases; "torch": all weights and biases
      uniform within 1 / sqrt(fan-in), as in ``torch.nn.Linear``, and ``output_scale``
      is not used
    """

    hidden_sizes: Sequence[int]
    num_outputs: int
    output_scale: float = 1.0
    initializer: str = "orthogonal"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Returns [..., num_outputs] of ``x`` [..., O]; ValueError: unknown initialiser."""
        check_name("initializer", self.initializer, dict.fromkeys(INITIALIZERS))
        for size in self.hidden_sizes:
            x = nn.tanh(self._dense(x, size, nn.initializers.lecun_normal()))
        return self._dense(x, self.num_outputs, nn.initializers.orthogonal(self.output_scale))

    def _dense(self, x: jax.Array, size: int, kernel_init: nn.initializers.Initializer):
        bias_init = nn.initializers.zeros
        if self.initializer == "torch":
            kernel_init = bias_init = _symmetric_uniform(x.shape[-1] ** -0.5)
        return nn.Dense(size, kernel_init=kernel_init, bias_init=bias_init, precision=_PRECISION)(x)


def _symmetric_uniform(bound: float) -> nn.initializers.Initializer:
    """Returns an initialiser that draws from the uniform distribution on (-bound, bound)."""

    def draw(key, shape, dtype=float, out_sharding=None):
        del out_sharding
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return draw
