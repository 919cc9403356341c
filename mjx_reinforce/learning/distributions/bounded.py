"""Families of Normals that keep actions in their range: clipped, through a tanh, or truncated."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.learning.distributions import normal_integrals
from mjx_reinforce.learning.distributions.distribution import Distribution, middle_and_half_range
from mjx_reinforce.learning.distributions.gaussian import (
    gaussian_outputs,
    normal_entropy,
    normal_log_density,
)
from mjx_reinforce.learning.distributions.normal_integrals import LOG_SQRT_2PI, log_tail

# float32 cannot recover a z much beyond the first number from tanh(z). Samples beyond it are all
# recorded as the second.
_SATURATED, _SATURATION = 5.0, 6.0


def clipped_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, clipped to the action's range.

    The environment sees only the clipped action, so ``log_prob`` is the log of that
    action's probability: the Normal's density inside the range, and at a bound the
    probability of everything that is clipped to it. The gradient has the same mean as
    that of ``normal`` and less variance (Fujita and Maeda 2018, arXiv:1802.07564,
    equation 8). ``entropy`` is that of the clipped action, -E[log_prob].

    Args:
      space: the action bounds, [A] each, finite.
      std: as in ``normal``, of the Normal before it is clipped.
      initial_std: as in ``normal``.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.clipped_normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    layout = gaussian_outputs("clipped-normal", space, std, initial_std, rescale, bounded=True)

    def log_density(action, mean, std):
        low, high = layout.bounds(mean)
        inside = normal_log_density(action, mean, std)
        below, above = log_tail((mean - low) / std), log_tail((high - mean) / std)
        return jnp.where(action <= low, below, jnp.where(action >= high, above, inside))

    return layout.family(
        sample=lambda noise, mean, std: jnp.clip(mean + std * noise, *layout.bounds(mean)),
        mode=lambda mean: jnp.clip(mean, *layout.bounds(mean)),
        log_density=log_density,
        entropy=lambda mean, std: _clipped_entropy(mean, std, *layout.bounds(mean)),
    )


def _clipped_entropy(mean: jax.Array, std: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Returns the entropy [...] of a clipped Normal in nats, entry by entry.

    Inside the range -log_prob is x^2 / 2 + log(std sqrt(2 pi)) with x = (action - mean) / std.
    With a and b the bounds in this unit, phi the standard Normal's density and P the probability
    of [a, b], the integral of x^2 phi(x) from a to b is P + a phi(a) - b phi(b). Each bound adds
    -p log p, with p the probability of what is clipped to it.
    """
    a, b = (low - mean) / std, (high - mean) / std
    log_below, log_above = log_tail(-a), log_tail(b)
    below, above = jnp.exp(log_below), jnp.exp(log_above)
    edges = b * jnp.exp(-0.5 * b**2 - LOG_SQRT_2PI) - a * jnp.exp(-0.5 * a**2 - LOG_SQRT_2PI)
    inside = (1.0 - below - above) * normal_entropy(std) - 0.5 * edges
    return inside - below * log_below - above * log_above


def tanh_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """A Normal mapped into the action's range by a tanh (Haarnoja et al. 2018, appendix C).

    The action is middle + half tanh(z), where middle + half z is a sample of ``normal``:
    a small deviation from the middle is hardly changed. ``log_prob`` recovers z from the
    action, to a thousandth of a standard unit up to |z| = 5, which is within 5e-5 of the
    range from a bound. Samples beyond are all recorded as z = 6 or -6 and counted with
    the probability of that whole tail, so the expected score is zero however far the
    policy saturates.

    ``mode`` is the tanh of the mean: the median, as is usual, not the densest point.
    ``entropy`` is exact to 1e-7 nats up to a standard deviation of 1 in z, 3e-3 at 3.

    Args:
      space: the action bounds, [A] each, finite.
      std: as in ``normal``, of the Normal before the tanh.
      initial_std: as in ``normal``.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.tanh_normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    layout = gaussian_outputs("tanh-normal", space, std, initial_std, rescale, bounded=True)
    middle, half = middle_and_half_range(layout.box)

    def of_z(mean, std):
        return (mean - middle) / half, std / half

    def sample(noise, mean, std):
        mean, std = of_z(mean, std)
        return middle + half * jnp.tanh(_saturate(mean + std * noise))

    return layout.family(
        sample=sample,
        mode=lambda mean: middle + half * jnp.tanh((mean - middle) / half),
        log_density=lambda action, mean, std: _tanh_log_density(
            (action - middle) / half, *of_z(mean, std), half
        ),
        entropy=lambda mean, std: _tanh_entropy(*of_z(mean, std), half),
    )


def _saturate(z: jax.Array) -> jax.Array:
    """Returns ``z`` [...], with one value a side for all that is saturated."""
    return jnp.where(jnp.abs(z) < _SATURATED, z, jnp.sign(z) * _SATURATION)


def _tanh_log_density(
    squashed: jax.Array, mean: jax.Array, std: jax.Array, half: np.ndarray
) -> jax.Array:
    """Returns the log-probability [..., A] of half tanh(z), where z is Normal.

    Args:
      squashed: [..., A] tanh(z).
      mean: [..., A] of z.
      std: [..., A] of z.
      half: [A] half the width of the action's range.
    """
    saturated = jnp.abs(squashed) > 0.5 * (np.tanh(_SATURATED) + np.tanh(_SATURATION))
    z = jnp.arctanh(jnp.where(saturated, 0.0, squashed))
    inside = normal_log_density(z, mean, std) - _log_tanh_slope(z) - np.log(half)
    beyond = log_tail((_SATURATED - jnp.sign(squashed) * mean) / std)
    return jnp.where(saturated, beyond, inside)


def _tanh_entropy(mean: jax.Array, std: jax.Array, half: np.ndarray) -> jax.Array:
    """Returns the differential entropy [..., A] in nats of half tanh(z), where z is Normal.

    It is the entropy of z plus E[log(1 - tanh(z)^2)] + log(half), the expectation by
    Gauss-Hermite quadrature.

    Args:
      mean: [..., A] of z.
      std: [..., A] of z.
      half: [A] half the width of the action's range.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(32)
    rule = zip(nodes.tolist(), (weights / np.sum(weights)).tolist(), strict=True)
    slopes = [weight * _log_tanh_slope(mean + std * node) for node, weight in rule]
    return normal_entropy(std) + sum(slopes) + np.log(half)


def _log_tanh_slope(z: jax.Array) -> jax.Array:
    """Returns log(1 - tanh(z)^2) [...] without cancellation."""
    return 2.0 * (float(np.log(2.0)) - z - jax.nn.softplus(-2.0 * z))


def truncated_normal(
    space: Box | Discrete,
    *,
    std: str = "parameter",
    initial_std: float = 0.5,
    rescale: bool = True,
) -> Distribution:
    """An independent Normal in each entry, restricted to the action's range.

    Density, entropy and their gradients stay exact when the mean is far outside the
    range, and so does the sampling, by the inverse distribution function; see
    ``mjx_reinforce.learning.distributions.normal_integrals``. The noise is uniform in (0, 1).

    Args:
      space: the action bounds, [A] each, finite.
      std: as in ``normal``, of the Normal before it is restricted.
      initial_std: as in ``normal``.
      rescale: False takes the network's output as the mean itself.

    Returns:
      The distribution, with A ("parameter") or 2A network outputs.

    Raises:
      ValueError: as in ``normal``, or an entry is unbounded.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.truncated_normal(mr.Box(-np.ones(2), np.ones(2)))
      >>> outputs = jnp.append(jnp.zeros(2), jnp.asarray(family.constants))
      >>> family.mode(outputs).tolist(), family.log_prob(outputs, jnp.zeros(2)).shape
      ([0.0, 0.0], ())
    """
    layout = gaussian_outputs("truncated-normal", space, std, initial_std, rescale, bounded=True)

    def restricted(function):
        """Returns a function that is given the bounds after its other arguments."""
        return lambda *given: function(*given, *layout.bounds(given[-1]))

    return layout.family(
        sample=restricted(normal_integrals.transform),
        mode=restricted(jnp.clip),
        log_density=restricted(normal_integrals.log_density),
        entropy=restricted(normal_integrals.entropy),
        noise=_open_uniform,
    )


def _open_uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns uniform noise that is never 0 or 1.

    The generator returns multiples of the dtype's epsilon, 0 among them; half an
    epsilon is added.
    """
    noise = jax.random.uniform(key, shape)
    return noise + 0.5 * jnp.finfo(noise.dtype).eps
