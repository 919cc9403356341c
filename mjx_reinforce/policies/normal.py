"""Normal distributions over actions, and how a network's outputs hold their parameters."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.policies.distribution import Distribution
from mjx_reinforce.types import Box, Discrete

LOG_SQRT_2PI = 0.5 * float(np.log(2.0 * np.pi))
_MIN_STD = 1e-6


def normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, unbounded.

    The mean is the middle of the action's range plus half the range times the
    network's output, so that an output of order one uses the range; unbounded
    entries are taken as they are. Samples may fall outside the bounds: the
    environment, not the policy, decides what that means (MuJoCo clamps inside
    the actuator).

    Args:
      space: the action bounds, [A] each.
      std: "parameter" for one trained log-std an entry, the same in all states
        (Schulman et al. 2015, arXiv:1502.05477); "softplus" for log(1 + exp(o))
        of a second network output (Gymnasium's REINFORCE tutorial); "sigmoid" for
        1 / (1 + exp(-o)), which stays below 1.
      initial_std: the standard deviation before training, in the action's unit.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: the space is discrete, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.
    """
    base = gaussian("normal", space, std, initial_std, rescale)

    def sample(outputs, noise):
        mean, scale = base.split(outputs)
        return mean + scale * noise

    def log_prob(outputs, action):
        return jnp.sum(normal_log_density(action, *base.split(outputs)), axis=-1)

    def entropy(outputs):
        return jnp.sum(normal_entropy(base.split(outputs)[1]), axis=-1)

    return base.distribution(sample, lambda outputs: base.split(outputs)[0], log_prob, entropy)


def normal_softplus(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent softplus standard deviation."""
    return normal(space, std="softplus", initial_std=initial_std, rescale=rescale)


def normal_sigmoid(
    space: Box | Discrete, *, initial_std: float = 0.5, rescale: bool = True
) -> Distribution:
    """``normal`` with a state-dependent sigmoid standard deviation, below 1."""
    return normal(space, std="sigmoid", initial_std=initial_std, rescale=rescale)


def deterministic(
    space: Box | Discrete, *, initial_std: float | None = None, rescale: bool = True
) -> Distribution:
    """A point: the action is the output, rescaled as the mean of ``normal``.

    For methods that need no likelihood, such as ``ars``; ``log_prob`` raises
    ValueError.

    Args:
      space: the action bounds, [A] each.
      initial_std: taken so that all families are built alike, and not used.
      rescale: False takes the network's output as the action itself.
    """
    del initial_std
    base = gaussian("deterministic", space, "parameter", 1.0, rescale)

    def mode(outputs):
        return base.mean(outputs)

    def log_prob(outputs, action):
        raise ValueError(
            "a deterministic policy has no log-probability; choose a stochastic one for REINFORCE"
        )

    return Distribution(
        num_outputs=base.size,
        constants=(),
        noise=lambda key, shape: jnp.zeros((*shape, 1)),
        sample=lambda outputs, noise: mode(outputs),
        mode=mode,
        log_prob=log_prob,
        entropy=lambda outputs: jnp.zeros(outputs.shape[:-1], outputs.dtype),
    )


class GaussianOutputs(NamedTuple):
    """How the outputs hold the means and standard deviations of a family's Normals.

    size: A
    std: "parameter", "softplus" or "sigmoid"
    initial_std: the standard deviation before training
    middle: [A] the mean at output 0
    half: [A] what an output of 1 adds to it
    """

    size: int
    std: str
    initial_std: float
    middle: np.ndarray
    half: np.ndarray

    def mean(self, outputs: jax.Array) -> jax.Array:
        """Returns the means [..., A]."""
        return outputs[..., : self.size] * self.half + self.middle

    def split(self, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the means and standard deviations, [..., A] each."""
        raw, initial = outputs[..., self.size :], self.initial_std
        # The shifts make the std equal initial_std at output 0, where a fresh network starts.
        if self.std == "parameter":
            std = jnp.exp(raw)
        elif self.std == "softplus":
            std = jax.nn.softplus(raw + float(np.log(np.expm1(initial)))) + _MIN_STD
        else:
            std = jax.nn.sigmoid(raw + float(np.log(initial / (1.0 - initial)))) + _MIN_STD
        return self.mean(outputs), std

    def distribution(self, sample, mode, log_prob, entropy, noise=None) -> Distribution:
        """Returns the distribution; its noise is standard Normal unless given."""
        constant = self.std == "parameter"
        draw = jax.random.normal if noise is None else noise
        return Distribution(
            num_outputs=self.size if constant else 2 * self.size,
            constants=(float(np.log(self.initial_std)),) * self.size if constant else (),
            noise=lambda key, shape: draw(key, (*shape, self.size)),
            sample=sample,
            mode=mode,
            log_prob=log_prob,
            entropy=entropy,
            num_scales=0 if constant else self.size,
        )


def gaussian(
    name: str, space: Box | Discrete, std: str, initial_std: float, rescale: bool
) -> GaussianOutputs:
    """Checks what all Gaussian families require, and lays out their outputs."""
    if not isinstance(space, Box):
        raise ValueError(
            f"{name} needs a continuous action space, this one is discrete; choose categorical"
        )
    if std not in ("parameter", "softplus", "sigmoid"):
        raise ValueError(f"std must be 'parameter', 'softplus' or 'sigmoid', got {std!r}")
    if not (np.isfinite(initial_std) and initial_std > 0):
        raise ValueError(f"initial_std must be positive and finite, got {initial_std}")
    if std == "sigmoid" and initial_std >= 1:
        raise ValueError(f"a sigmoid std stays below 1, got initial_std={initial_std}")
    size = len(space.low)
    middle, half = np.zeros(size, np.float32), np.ones(size, np.float32)
    if rescale:
        middle, half = middle_and_half_range(space)
    return GaussianOutputs(size, std, initial_std, middle, half)


def middle_and_half_range(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centre and half the width of each bounded entry, 0 and 1 for the others."""
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2


def normal_log_density(x: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Returns the log-density at ``x``, entry by entry."""
    return -0.5 * ((x - mean) / std) ** 2 - jnp.log(std) - LOG_SQRT_2PI


def normal_entropy(std: jax.Array) -> jax.Array:
    """Returns the entropy in nats, entry by entry."""
    return jnp.log(std) + 0.5 + LOG_SQRT_2PI
