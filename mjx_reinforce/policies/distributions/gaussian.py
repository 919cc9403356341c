"""What the Gaussian families share: the means and standard deviations in a network's outputs."""

from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mjx_reinforce.policies.arguments import check_number, known_number
from mjx_reinforce.policies.distributions.action_range import continuous_box, middle_and_half_range
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.types import Box, Discrete

LOG_SQRT_2PI = 0.5 * float(np.log(2.0 * np.pi))
_MIN_STD = 1e-6


class GaussianOutputs(NamedTuple):
    """Where the outputs hold the means and standard deviations of a family's Normals.

    size: A
    std: "parameter", "softplus" or "sigmoid"
    initial_std: the standard deviation before training
    middle: [A] the mean where the network's output is 0
    half: [A] what a network output of 1 adds to it
    """

    size: int
    std: str
    initial_std: float | jax.Array
    middle: np.ndarray
    half: np.ndarray

    def mean(self, outputs: jax.Array) -> jax.Array:
        """Returns the means [..., A]."""
        return outputs[..., : self.size] * self.half + self.middle

    def split(self, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the means and standard deviations, [..., A] each."""
        raw, initial = outputs[..., self.size :], self.initial_std
        # A fresh network's outputs are near 0; the added constants make the std initial_std there.
        if self.std == "parameter":
            std = jnp.exp(raw)
        elif self.std == "softplus":
            std = jax.nn.softplus(raw + float(np.log(np.expm1(initial)))) + _MIN_STD
        else:
            std = jax.nn.sigmoid(raw + float(np.log(initial / (1.0 - initial)))) + _MIN_STD
        return self.mean(outputs), std

    def distribution(self, sample, mode, log_prob, entropy, noise=None, kl=None) -> Distribution:
        """Returns the distribution of these functions; its noise is standard Normal by default."""
        constant = self.std == "parameter"
        draw = jax.random.normal if noise is None else noise
        return Distribution(
            num_outputs=self.size if constant else 2 * self.size,
            constants=(_log(self.initial_std),) * self.size if constant else (),
            noise=lambda key, shape: draw(key, (*shape, self.size)),
            sample=sample,
            mode=mode,
            log_prob=log_prob,
            entropy=entropy,
            num_scales=0 if constant else self.size,
            std=lambda outputs: self.split(outputs)[1],
            kl=kl,
        )


def gaussian_outputs(
    name: str, space: Box | Discrete, std: str, initial_std: float | jax.Array, rescale: bool
) -> GaussianOutputs:
    """Checks the arguments of a Gaussian family and returns the layout of its outputs.

    Args:
      name: the family's name, for the messages.
      space: the action bounds, [A] each.
      std: "parameter", "softplus" or "sigmoid", as in ``normal``.
      initial_std: the standard deviation before training, in the action's unit; for "parameter"
        it may be traced, and is then taken on trust.
      rescale: False takes the network's output as the mean itself.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.
    """
    box = continuous_box(name, space)
    if std not in ("parameter", "softplus", "sigmoid"):
        raise ValueError(f"std must be 'parameter', 'softplus' or 'sigmoid', got {std!r}")
    check_number("initial_std", initial_std, positive=True)
    number = known_number(initial_std)
    if std == "sigmoid" and number is not None and number >= 1:
        raise ValueError(f"a sigmoid std stays below 1, got initial_std={number}")
    size = len(box.low)
    middle, half = np.zeros(size, np.float32), np.ones(size, np.float32)
    if rescale:
        middle, half = middle_and_half_range(box)
    return GaussianOutputs(size, std, initial_std, middle, half)


def _log(x: ArrayLike) -> Any:
    """Returns a logarithm, rounded once where the number is known."""
    return jnp.log(x) if isinstance(x, jax.core.Tracer) else float(np.log(x))


def normal_log_density(x: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Returns the log-density [...] of a Normal at ``x``, entry by entry."""
    return -0.5 * ((x - mean) / std) ** 2 - jnp.log(std) - LOG_SQRT_2PI


def normal_entropy(std: jax.Array) -> jax.Array:
    """Returns the entropy [...] of a Normal in nats, entry by entry."""
    return jnp.log(std) + 0.5 + LOG_SQRT_2PI


def normal_kl(
    mean: jax.Array, std: jax.Array, other_mean: jax.Array, other_std: jax.Array
) -> jax.Array:
    """Returns KL(Normal(mean, std) || Normal(other_mean, other_std)) [...] in nats.

    That is log(q / p) + (p^2 + d^2) / (2 q^2) - 1/2 with the standard deviations p and q and the
    means d apart, arranged so that nearly equal ones do not cancel.
    """
    log_ratio = jnp.log(std / other_std)
    width = 0.5 * jnp.expm1(2.0 * log_ratio) - log_ratio
    return width + 0.5 * ((mean - other_mean) / other_std) ** 2
