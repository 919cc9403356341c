"""Families of a Normal in each entry of the action, and what they share.

``gaussian_outputs`` lays out means and standard deviations in a network's outputs; its ``family``
makes a distribution of what is done to a single Normal. ``bounded`` has the families that keep
actions in their range.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import check_number, known_number
from mjx_reinforce.learning.distributions.distribution import (
    Distribution,
    continuous_box,
    middle_and_half_range,
)
from mjx_reinforce.learning.distributions.normal_integrals import LOG_SQRT_2PI

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
    network's output, so that outputs between -1 and 1 cover the range; in an unbounded
    entry the mean is the output itself. Samples may fall outside the bounds, and the
    environment decides what then happens (MuJoCo clamps them in the actuator).

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

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    layout = gaussian_outputs("normal", space, std, initial_std, rescale)

    def kl(outputs, others):
        return jnp.sum(normal_kl(*layout.split(outputs), *layout.split(others)), axis=-1)

    def fisher(constants):
        return jnp.concatenate([(layout.half * jnp.exp(-constants)) ** 2, 2.0 + 0.0 * constants])

    family = layout.family(
        sample=lambda noise, mean, std: mean + std * noise,
        mode=lambda mean: mean,
        log_density=normal_log_density,
        entropy=lambda mean, std: normal_entropy(std),
    )
    return family._replace(kl=kl, fisher=fisher if std == "parameter" else None)


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
    """A single point: the action is the network's output, rescaled like the mean of ``normal``.

    It is for methods that need no likelihood, such as ``ars``: ``log_prob`` raises
    ValueError.

    Args:
      space: the action bounds, [A] each.
      initial_std: not used; every family takes it.
      rescale: False takes the network's output as the action itself.

    Returns:
      The distribution, with A network outputs.

    Raises:
      ValueError: the space is discrete.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.deterministic(mr.Box(-2 * np.ones(1), 2 * np.ones(1)))
      >>> family.mode(jnp.ones(1)).tolist()  # 1 is the end of the range
      [2.0]
    """
    del initial_std
    layout = gaussian_outputs("deterministic", space, "parameter", 1.0, rescale)

    def log_prob(outputs, action):
        raise ValueError(
            "a deterministic policy has no log-probability; choose a stochastic one for REINFORCE"
        )

    return Distribution(
        num_outputs=layout.size,
        constants=(),
        noise=lambda key, shape: jnp.zeros((*shape, 1)),
        sample=lambda outputs, noise: layout.mean(outputs),
        mode=layout.mean,
        log_prob=log_prob,
        entropy=lambda outputs: jnp.zeros(outputs.shape[:-1], outputs.dtype),
    )


class GaussianOutputs(NamedTuple):
    """Where the outputs hold the means and standard deviations of a family's Normals.

    box: the action bounds, [A] each
    std: "parameter", "softplus" or "sigmoid"
    initial_std: the standard deviation before training
    middle: [A] the mean where the network's output is 0
    half: [A] what a network output of 1 adds to it
    """

    box: Box
    std: str
    initial_std: float | jax.Array
    middle: np.ndarray
    half: np.ndarray

    @property
    def size(self) -> int:
        """A."""
        return len(self.middle)

    def bounds(self, like: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the lower and upper bounds, [A] each, in the dtype of ``like``."""
        return jnp.asarray(self.box.low, like.dtype), jnp.asarray(self.box.high, like.dtype)

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

    def family(
        self,
        *,
        sample: Callable[..., Any],
        mode: Callable[..., Any],
        log_density: Callable[..., Any],
        entropy: Callable[..., Any],
        noise: Callable[..., Any] = jax.random.normal,
    ) -> Distribution:
        """Returns the distribution of independent entries.

        Args:
          sample: (noise, mean, std) -> action, [..., A] each.
          mode: (mean) -> action.
          log_density: (action, mean, std) -> the log-probability of each entry.
          entropy: (mean, std) -> that of each entry, in nats.
          noise: (key, shape) -> what ``sample`` transforms.
        """
        constant = self.std == "parameter"
        return Distribution(
            num_outputs=self.size if constant else 2 * self.size,
            constants=(_log(self.initial_std),) * self.size if constant else (),
            noise=lambda key, shape: noise(key, (*shape, self.size)),
            sample=lambda outputs, noise: sample(noise, *self.split(outputs)),
            mode=lambda outputs: mode(self.mean(outputs)),
            log_prob=lambda outputs, action: jnp.sum(
                log_density(action, *self.split(outputs)), axis=-1
            ),
            entropy=lambda outputs: jnp.sum(entropy(*self.split(outputs)), axis=-1),
            num_scales=0 if constant else self.size,
            std=lambda outputs: self.split(outputs)[1],
        )


def gaussian_outputs(
    name: str,
    space: Box | Discrete,
    std: str,
    initial_std: float | jax.Array,
    rescale: bool,
    *,
    bounded: bool = False,
) -> GaussianOutputs:
    """Checks the arguments of a Gaussian family and returns the layout of its outputs.

    Args:
      name: the family's name, for the messages.
      space: the action bounds, [A] each.
      std: "parameter", "softplus" or "sigmoid", as in ``normal``.
      initial_std: the standard deviation before training, in the action's unit; for "parameter"
        it may be traced, and is then taken on trust.
      rescale: False takes the network's output as the mean itself.
      bounded: whether the family needs finite bounds.

    Raises:
      ValueError: the space is discrete or not bounded, ``std`` is unknown, or ``initial_std`` is
        not positive or, for "sigmoid", not below 1.
    """
    box = continuous_box(name, space, bounded=bounded)
    if std not in ("parameter", "softplus", "sigmoid"):
        raise ValueError(f"std must be 'parameter', 'softplus' or 'sigmoid', got {std!r}")
    check_number("initial_std", initial_std, positive=True)
    number = known_number(initial_std)
    if std == "sigmoid" and number is not None and number >= 1:
        raise ValueError(f"a sigmoid std stays below 1, got initial_std={number}")
    middle, half = middle_and_half_range(box)
    if not rescale:
        middle, half = np.zeros_like(middle), np.ones_like(half)
    return GaussianOutputs(box, std, initial_std, middle, half)


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
